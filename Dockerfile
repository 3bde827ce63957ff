# arctrack with GigE Vision cameras (Aravis), as a user without rights: docs/how_to/deploy.md says how to run it.
# Debian's Python, since PyGObject and Aravis are compiled for it.

# What a clone needs beside its own environment to be tested: CONTRIBUTING.md says how to run it.
FROM debian:12-slim AS test
COPY .ci/system /usr/local/bin/arctrack-system
RUN apt-get update \
    && apt-get install --yes --no-install-recommends ca-certificates git g++ python3-dev python3-venv \
    && arctrack-system \
    && rm -rf /var/lib/apt/lists/* \
    && git config --system --add safe.directory /clone
WORKDIR /clone

FROM debian:12-slim AS build
# The compiler is for autosar-e2e, which has no wheel for ARM.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ python3-dev python3-venv \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /source
COPY requirements.lock .
RUN python3 -m venv /opt/arctrack \
    && /opt/arctrack/bin/pip install --no-cache-dir --require-hashes -r requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY arctrack arctrack
COPY calibration calibration
COPY noise_model noise_model
COPY robot_io robot_io
COPY sim_to_real sim_to_real
COPY tracker tracker
RUN /opt/arctrack/bin/pip install --no-cache-dir --no-deps --no-build-isolation .

FROM debian:12-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 gir1.2-aravis-0.8 python3-gi \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/arctrack /opt/arctrack
RUN useradd --create-home --groups video,dialout arctrack \
    && install -d -o arctrack /data
# matplotlib keeps its list of fonts there: the root may be read-only.
ENV PATH=/opt/arctrack/bin:$PATH MPLCONFIGDIR=/tmp/matplotlib
USER arctrack
WORKDIR /data
# Of a live run: its page says whether the loop steps. A replay ends by itself.
HEALTHCHECK --interval=10s --start-period=60s \
    CMD ["python3", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8765/health', timeout=5)"]
ENTRYPOINT ["arctrack"]
CMD ["--help"]
