"""From a decoded message to plain values."""
