"""Examples: each is run by itself, as `python examples/NAME.py`."""
