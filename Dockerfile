# One image for the API and the worker. Build arguments:
#   PYTHON             version of Python
#   EXTRA_INDEX_URL    an additional package index, for instance one with a CPU-only build of torch
ARG PYTHON=3.11

FROM python:${PYTHON}-slim-bookworm AS build
# No version pins: the compiler leaves no trace in the final image except the one kernel it compiles.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ \
    && rm -rf /var/lib/apt/lists/*
RUN python -m venv /opt/venv
ENV PATH=/opt/venv/bin:$PATH \
    PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /build

# The dependencies alone, so that a change of the source does not install them again.
ARG EXTRA_INDEX_URL=""
COPY pyproject.toml constraints.txt ./
RUN python -c "import tomllib; print(*tomllib.load(open('pyproject.toml', 'rb'))['project']['dependencies'], sep='\n')" \
        > requirements.txt \
    && pip install ${EXTRA_INDEX_URL:+--extra-index-url "$EXTRA_INDEX_URL"} -c constraints.txt -r requirements.txt

COPY CMakeLists.txt LICENSE README.md ./
COPY mass_engine mass_engine
COPY service service
COPY worker worker
RUN pip install --no-deps .

# The tracker's networks, checked against their digests. At run time nothing is fetched.
ENV MASS_MODEL_DIR=/opt/mass/models
WORKDIR /
RUN python -m mass_engine.tracking.models


FROM python:${PYTHON}-slim-bookworm AS run
RUN groupadd --gid 10001 mass \
    && useradd --uid 10001 --gid mass --no-create-home --home-dir /tmp --shell /usr/sbin/nologin mass \
    && install -d -o mass -g mass -m 0750 /data
COPY --from=build /opt/venv /opt/venv
COPY --from=build /opt/mass/models /opt/mass/models
ENV PATH=/opt/venv/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    PYTHONUNBUFFERED=1 \
    HOME=/tmp \
    MASS_MODEL_DIR=/opt/mass/models \
    MASS_DATA_DIR=/data
USER 10001:10001
WORKDIR /data
# A new volume takes over the owner of this directory.
VOLUME /data
EXPOSE 8000
# On its own the image is a whole service: broker, API and one worker. Compose runs them apart.
CMD ["mass", "serve", "--host", "0.0.0.0"]
