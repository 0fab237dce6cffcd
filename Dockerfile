# The query server, in two stages: what is needed to build stays behind. It runs as a user without
# rights, reads /bags, writes nothing there, and listens on the container's port 9203. Other
# containers reach that, so it does not start without a token that clients show:
#
#   docker build -t ros2-memory .
#   export MEMORY_API_TOKEN=$(openssl rand -hex 32)
#   docker run --rm --read-only --tmpfs /tmp -p 127.0.0.1:9203:9203 -v ~/bags:/bags:ro \
#     -e MEMORY_API_TOKEN ros2-memory
#
# deploy/compose.yaml does the same.
#
# The recorder needs the robot's own ROS installation and is not in here.

# Pinned by tag, not by digest, which could not be looked up where this was written.
FROM python:3.11-slim AS build
WORKDIR /src
RUN pip install --no-cache-dir uv==0.13.8
ENV UV_PROJECT_ENVIRONMENT=/opt/ros2-memory UV_COMPILE_BYTECODE=1
COPY pyproject.toml uv.lock README.md LICENSE ./
# The dependencies alone first: a layer that only a change of the lock rebuilds.
RUN uv sync --locked --no-default-groups --no-install-project
COPY src src
COPY config config
RUN uv sync --locked --no-default-groups --no-editable

FROM python:3.11-slim
RUN useradd --system --no-create-home --shell /usr/sbin/nologin ros2-memory
COPY --from=build /opt/ros2-memory /opt/ros2-memory
USER ros2-memory
WORKDIR /tmp
# Inside the container every interface is the container's own; who else may reach the port is
# decided by what it is published on, above only the machine itself.
ENV PATH=/opt/ros2-memory/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    MEMORY_BAG_DIR=/bags \
    MEMORY_DEPLOYMENT=query_only \
    MCP_TRANSPORT=sse \
    MCP_HOST=0.0.0.0 \
    MCP_PORT=9203
VOLUME /bags
EXPOSE 9203
HEALTHCHECK --interval=30s --timeout=5s --start-period=10s \
  CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:9203/health', timeout=4)"]
ENTRYPOINT ["ros2-memory-server"]
