"""Commands that list what is recorded: topics, recordings, and messages one by one."""
