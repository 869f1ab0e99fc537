"""Files for other tools: a policy as an ONNX model, trajectories as CSV, CCSDS OEM and CZML."""
