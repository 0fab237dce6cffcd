# Sourced by the scripts here: uv on PATH, and no Python that it would have to download.
export UV_PYTHON_DOWNLOADS=never

# Where uv is missing, pip installs it beside the build, which leaves the machine's Python as it is
# (and a Python that refuses packages of its own, PEP 668, is no obstacle).
if ! command -v uv >/dev/null; then
  printf '\n=== uv: not on PATH, installing it with pip in build/uv\n'
  python3 -m venv build/uv
  build/uv/bin/python -m pip install --quiet uv
  PATH="$PWD/build/uv/bin:$PATH"
fi
