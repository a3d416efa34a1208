# docker build -t verifai_jax . && docker run --rm --user "$(id -u):$(id -g)" -v "$PWD:/work" \
#   verifai_jax falsify spec.py:upright
# No digest of the base is known to be that of the tests, so it gets its repairs; to fix one:
# docker build --build-arg BASE=python:3.11-slim@sha256:... .
ARG BASE=python:3.11-slim
FROM ${BASE}
# Exported monitors and native code are compiled where they run.
RUN apt-get update && apt-get install --yes --no-install-recommends g++ && rm -rf /var/lib/apt/lists/*
COPY . /source
# The versions that the tests run with.
RUN pip install --no-cache-dir -c /source/constraints.txt "/source[mujoco,gymnasium,optuna]" \
    && rm -r /source \
    && useradd --create-home verifier \
    && mkdir --mode=1777 /home/anyone
# Whoever runs it, by --user, has a name and a place for caches.
ENV HOME=/home/anyone USER=verifier LOGNAME=verifier
USER verifier
WORKDIR /work
ENTRYPOINT ["verifai-jax"]
CMD ["--help"]
