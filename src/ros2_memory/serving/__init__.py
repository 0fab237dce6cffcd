"""Dispatch, the MCP server, HTTP, access, limits, health, and the filling of the store."""
