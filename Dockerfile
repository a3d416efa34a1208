# docker build -t verifai_jax . && docker run --rm -v "$PWD:/work" verifai_jax falsify spec.py:upright
FROM python:3.11-slim
COPY . /source
# The versions that the tests run with.
RUN pip install --no-cache-dir -c /source/constraints.txt "/source[mujoco,gymnasium,optuna]" \
    && rm -r /source \
    && useradd --create-home verifier
USER verifier
WORKDIR /work
ENTRYPOINT ["verifai-jax"]
CMD ["--help"]
