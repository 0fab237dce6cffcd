"""Tool declarations, their arguments, and replies as JSON."""
