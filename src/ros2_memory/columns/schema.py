"""The tables of the store."""

from __future__ import annotations

from typing import Final

PRAGMAS: Final = (
    "page_size = 4096",
    "cache_size = -64",  # KiB: a server may have hundreds open, and the kernel has their pages
    "auto_vacuum = INCREMENTAL",
    "secure_delete = ON",
)
"""Of each connection, before anything else: deleted rows are overwritten, and pages that become
free go back to the disk."""
TABLES: Final = (
    "bag",
    "summary",
    "topic",
    "definition",
    "part",
    "part_column",
    "zone",
    "fragment",
    "fragment_part",
    "listing",
    "deletion",
)
STATEMENTS: Final = """
CREATE TABLE bag (id INTEGER PRIMARY KEY AUTOINCREMENT, path TEXT NOT NULL UNIQUE,
  size INTEGER NOT NULL, mtime_ns INTEGER NOT NULL, sidecar_ns INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, messages INTEGER NOT NULL,
  hashed INTEGER NOT NULL, definitions TEXT NOT NULL, summary INTEGER NOT NULL,
  counts BLOB NOT NULL);
CREATE TABLE summary (id INTEGER PRIMARY KEY, topics TEXT NOT NULL UNIQUE);
CREATE TABLE topic (id INTEGER PRIMARY KEY AUTOINCREMENT, name TEXT NOT NULL,
  encoding TEXT NOT NULL, latched INTEGER NOT NULL, definition INTEGER NOT NULL,
  layout TEXT NOT NULL,
  UNIQUE (name, encoding, latched, definition, layout));
CREATE TABLE definition (id INTEGER PRIMARY KEY, type TEXT NOT NULL, encoding TEXT NOT NULL,
  text BLOB NOT NULL, UNIQUE (type, encoding, text));
CREATE TABLE part (id INTEGER PRIMARY KEY AUTOINCREMENT, topic INTEGER NOT NULL,
  first_ns INTEGER NOT NULL, last_ns INTEGER NOT NULL, messages INTEGER NOT NULL,
  bags TEXT NOT NULL, dropped TEXT NOT NULL, bytes INTEGER NOT NULL, level INTEGER NOT NULL);
CREATE INDEX part_of_topic ON part (topic, first_ns, last_ns);
CREATE INDEX part_of_level ON part (level);
CREATE TABLE part_column (part INTEGER NOT NULL, path TEXT NOT NULL, same TEXT,
  data BLOB, UNIQUE (part, path));
CREATE TABLE zone (topic INTEGER NOT NULL, path TEXT NOT NULL, part INTEGER NOT NULL,
  codec TEXT NOT NULL, count INTEGER NOT NULL, error REAL NOT NULL, least, greatest,
  nulls INTEGER NOT NULL, words TEXT, PRIMARY KEY (topic, path, part)) WITHOUT ROWID;
CREATE TABLE fragment (id INTEGER PRIMARY KEY AUTOINCREMENT, kind TEXT NOT NULL,
  settings TEXT NOT NULL, start_ns INTEGER NOT NULL, parts TEXT NOT NULL, data BLOB NOT NULL,
  UNIQUE (kind, settings, start_ns, parts));
CREATE TABLE fragment_part (part INTEGER NOT NULL, fragment INTEGER NOT NULL,
  PRIMARY KEY (part, fragment)) WITHOUT ROWID;
CREATE TABLE listing (folder TEXT PRIMARY KEY, listed TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE deletion (id INTEGER PRIMARY KEY AUTOINCREMENT);
"""
"""Separated by semicolons."""
