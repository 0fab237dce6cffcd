"""The files below `.episodic/`: what the recorder remembers, and what it is asked to do."""
