"""A month of a robot's tasks and actions, and a hundred questions about them with their truths."""
