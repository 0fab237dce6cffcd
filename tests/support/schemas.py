"""The shipped schema map, and the extractor that it makes."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import yaml

from ros2_memory.extract import SchemaExtractor

SCHEMA_FILE = Path(__file__).resolve().parents[2] / "config" / "message_schemas.yaml"


@cache
def shipped_schemas() -> dict[str, dict[str, str]]:
    schemas: dict[str, dict[str, str]] = yaml.safe_load(SCHEMA_FILE.read_text("utf-8"))["schemas"]
    return schemas


def shipped_extractor(max_array_length: int = 50) -> SchemaExtractor:
    return SchemaExtractor(shipped_schemas(), max_array_length)
