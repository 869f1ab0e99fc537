"""What is taken along: a policy as an ONNX model, trajectories as CSV, CCSDS OEM and CZML."""
