"""The secret that a client shows to a server that others on the network can reach.

It comes from the environment, from a file, or from systemd's credentials, never from the
configuration: that is written to disk, and shown by whoever looks for a fault. No sentence here
repeats any of it.
"""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pydantic import SecretStr

from ros2_memory.core.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping, MutableMapping

VARIABLE: Final = "MEMORY_API_TOKEN"
FILE_VARIABLE: Final = "MEMORY_API_TOKEN_FILE"
CREDENTIAL: Final = "memory_api_token"
"""The name under which a systemd unit passes it: `LoadCredential=memory_api_token:PATH`."""
SHORTEST: Final = 16
LONGEST: Final = 1024

_HOW: Final = "make one with `openssl rand -hex 32`"
# What a bearer token may be made of: RFC 6750, section 2.1 (b64token).
_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/-]+=*")


def api_token(env: Mapping[str, str]) -> SecretStr | None:
    """The token that clients have to show; None where there is none.

    `MEMORY_API_TOKEN` is it, `MEMORY_API_TOKEN_FILE` names a file that holds it, and so does
    `memory_api_token` in `CREDENTIALS_DIRECTORY`, which systemd sets. An empty variable counts as
    unset, an empty file does not.

    Raises:
        ConfigError: it cannot be read, is given twice, or is none that can be shown in a header.
    """
    files: dict[str, Path] = {}
    if env.get(FILE_VARIABLE):
        files[FILE_VARIABLE] = Path(env[FILE_VARIABLE])
    credentials = env.get("CREDENTIALS_DIRECTORY")
    if credentials and (Path(credentials) / CREDENTIAL).exists():
        files[f"the credential {CREDENTIAL}"] = Path(credentials) / CREDENTIAL
    given = [*([VARIABLE] if env.get(VARIABLE) else []), *files]
    if not given:
        return None
    if len(given) > 1:
        raise ConfigError(f"{' and '.join(given)} both give the API token; leave one of them")
    source = given[0]
    text = _content(files[source], source) if source in files else env[VARIABLE]
    _require_usable(text, source)
    return SecretStr(text)


def take_token(env: MutableMapping[str, str], *, host: str, loopback: bool) -> SecretStr | None:
    """The token of a server on `host`; None only where no other machine can reach it.

    It is taken out of the environment, which programs that are started from here inherit.

    Raises:
        ConfigError: there must be one, or the one that there is cannot be used.
    """
    token = api_token(env)
    env.pop(VARIABLE, None)
    if token is None and not loopback:
        raise ConfigError(
            f"{VARIABLE}: missing; server.host is {host!r}, which other machines can reach, so "
            f"clients must show a token: {_HOW} and give it as {VARIABLE}, in a file that "
            f"{FILE_VARIABLE} names, or by LoadCredential={CREDENTIAL}:PATH in a systemd unit; "
            "or listen on 127.0.0.1, where none is needed"
        )
    return token


def _content(path: Path, source: str) -> str:
    """The file's text without the line's end; never waits, as opening a pipe would."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise ConfigError(f"{source}: {str(path)!r} is not a regular file")
            data = os.read(descriptor, LONGEST + 3)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise ConfigError(
            f"{source}: {str(path)!r} cannot be read: {error.strerror}; "
            "give the server's user a file that it may read"
        ) from None
    # Bytes that are no text are refused below, without being shown.
    return data.decode("ascii", errors="replace").removesuffix("\n").removesuffix("\r")


def _require_usable(text: str, source: str) -> None:
    if len(text) < SHORTEST:
        held = f"has {len(text)} characters" if text else "is empty"
        raise ConfigError(
            f"{source}: the API token {held}, and must have at least {SHORTEST}; {_HOW}"
        )
    if len(text) > LONGEST:
        raise ConfigError(
            f"{source}: the API token is longer than {LONGEST} characters, too long for a header; "
            f"{_HOW}"
        )
    if not _TOKEN.fullmatch(text):
        raise ConfigError(
            f"{source}: the API token holds characters that cannot stand in an Authorization "
            f"header; letters, digits and -._~+/ can, with = at the end; {_HOW}"
        )
