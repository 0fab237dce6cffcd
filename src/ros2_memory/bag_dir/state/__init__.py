"""The files below `.episodic/`: the recorder's state, and requests to it."""
