"""The ports `BagReader` and `BagWriter`, their adapters, and decoding."""
