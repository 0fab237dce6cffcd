"""Rules that keep what was recorded around an event: `recording.keep_when`."""
