"""Dispatch, the MCP server, HTTP, access, limits, health, and the catalogue's backfill."""
