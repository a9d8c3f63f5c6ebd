# Skyloop with its extra `all`: docs/platforms.md says how to run it.
#   docker build -t skyloop . && docker run --rm skyloop
ARG BASE=python:3.13-slim
FROM ${BASE} AS build
COPY . /skyloop
RUN python3 -m venv /opt/skyloop \
 && /opt/skyloop/bin/pip install --no-cache-dir --disable-pip-version-check '/skyloop[all]'

FROM ${BASE}
# Without rights: what it needs is sockets, shared memory and the folder that it works in.
RUN useradd --create-home skyloop && mkdir /work && chown skyloop /work
COPY --from=build /opt/skyloop /opt/skyloop
ENV PATH=/opt/skyloop/bin:$PATH PYTHONUNBUFFERED=1
USER skyloop
WORKDIR /work
# Ctrl-C and `docker stop` land what flies.
STOPSIGNAL SIGINT
ENTRYPOINT ["skyloop"]
CMD ["demo", "--headless", "--seconds", "30"]
