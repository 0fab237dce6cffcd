"""Lines of the logs in `.episodic`, as a test writes them by hand."""

from zlib import crc32


def with_checks(text: str) -> str:
    """Each line with the check that a log wants."""
    begun = [line.removesuffix("}") for line in text.splitlines()]
    return "".join(f'{each}, "crc32": "{crc32(each.encode()):08x}"}}\n' for each in begun)
