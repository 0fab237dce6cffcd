"""Where the API token is given: in the environment, in a file, or in systemd's credentials."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping

VARIABLE: Final = "MEMORY_API_TOKEN"
FILE_VARIABLE: Final = "MEMORY_API_TOKEN_FILE"
CREDENTIAL: Final = "memory_api_token"
"""The name under which a systemd unit passes the token: `LoadCredential=memory_api_token:PATH`."""


def given_tokens(env: Mapping[str, str]) -> dict[str, str | Path]:
    """Returns the token, or the path of its file, by the name of each source that gives one.

    An empty variable counts as unset, an empty file does not.
    """
    given: dict[str, str | Path] = {}
    if text := env.get(VARIABLE):
        given[VARIABLE] = text
    if file := env.get(FILE_VARIABLE):
        given[FILE_VARIABLE] = Path(file)
    credentials = env.get("CREDENTIALS_DIRECTORY")
    if credentials and (path := Path(credentials) / CREDENTIAL).exists():
        given[f"the credential {CREDENTIAL}"] = path
    return given
