"""What people take away: a policy as an ONNX model, its flights as CSV, CCSDS OEM and CZML, a flight as a page.

`folders.py` writes the files of a results or run folder. `offers.py` says what a family may offer, and `<family>.py`
has it. The other modules know only columns, tracks and pages.
"""
