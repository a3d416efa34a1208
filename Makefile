# `make falsify` and `make test` need Python >= 3.11, make and nothing else.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: help falsify test test-thorough test-slow test-all test-changed prove lint notebooks notebooks-short \
  notebooks-update bench policy wheel docs claims constraints clean

help:
	@echo "make falsify    set up, then break the trained cart-pole controller"
	@echo "make test       set up, then run the quick tests of every room"
	@echo "make test-thorough  those that take seconds, most of them to compile; .ci/run has them, too"
	@echo "make test-slow  these, and the slow ones: kills, clusters, trainings; for each push and release"
	@echo "make test-changed  all tests of what differs from main: BASE=REVISION for another one"
	@echo "make prove      what proves a number over many seeds: rates, coverage, learning curves"
	@echo "make test-all   all of these"
	@echo "make lint       ruff and pyright"
	@echo "make notebooks  execute the notebooks; their text must be what is stored"
	@echo "make notebooks-short  all of them but the longest; .ci/run has these"
	@echo "make notebooks-update  execute the notebooks and store what they show"
	@echo "make docs       build the documentation as a site, out/site/index.html"
	@echo "make bench      measure; see benchmarks/RESULTS.md"
	@echo "make claims     what the README claims, run again and compared"
	@echo "make policy     train the networks again from their seeds (the hopper: 7 minutes)"
	@echo "make constraints  write constraints.txt anew; VERSIONS=--newest for the newest of everything"

# Debian splits venv's pip into a package of its own; where it is missing, the pip of the system
# fills the environment.
PIP = if $(BIN)/python -m pip --version >/dev/null 2>&1; \
  then pip="$(BIN)/python -m pip"; else pip="$(PYTHON) -m pip --python $(BIN)/python"; fi
INSTALL = $(PIP); $$pip install -q --disable-pip-version-check -c constraints.txt

# The stamp is renewed when the dependencies change.
.venv/package: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("verifai_jax needs Python >= 3.11, this is " + sys.version.split()[0] + "; try make PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv 2>/dev/null || $(PYTHON) -m venv --without-pip --clear .venv
	@$(INSTALL) -e .
	@touch $@

.venv/installed: .venv/package
	@$(INSTALL) -e '.[test]'
	@touch $@

.venv/lint: .venv/installed
	@$(INSTALL) -e '.[lint]'
	@touch $@

# Scenic brings 700 MB and Ray 200, which the quick tests do without; the others are small, and as
# rarely used.
.venv/extras: .venv/installed
	@$(INSTALL) -e '.[scenic,diffrax,dask,ray]'
	@touch $@

.venv/docs: .venv/installed
	@$(INSTALL) -e '.[docs]'
	@touch $@

# Nothing is run and nothing is fetched; a broken link is an error.
docs: .venv/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --config-file website/mkdocs.yml

falsify: .venv/package
	$(BIN)/verifai-jax falsify specs/cartpole.py:balance --search uniform --budget 20000

# Tests of one file share what they compile, so a file stays with one worker; long files begin.
AS_A_USER := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations=10
# Programs of tests run for moments, so they are compiled in a hurry. Which flags do that depends on
# the version of XLA, which ends a process that gets one it does not know.
# Compiled files of tests are kept for the next run, whatever the environment says.
PYTEST = PYTHONDONTWRITEBYTECODE= JAX_DISABLE_MOST_OPTIMIZATIONS=1 XLA_FLAGS="$$($(BIN)/python tests/xla_flags.py)" $(AS_A_USER)

test: .venv/installed
	$(PYTEST)

test-thorough: .venv/extras
	$(PYTEST) -m "thorough and not slow and not proves"

test-slow: .venv/extras
	$(PYTEST) -m "(thorough or slow) and not proves"

# What a training ends with depends on every rounding, so these compile as a user does.
prove: .venv/extras
	$(AS_A_USER) -m proves

test-all: test test-slow prove

BASE ?= main
test-changed: .venv/extras
	@tests="$$($(BIN)/python tests/changed.py $(BASE))" && if [ -n "$$tests" ]; then \
	  $(PYTEST) -m "" $$tests; fi

lint: .venv/lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

notebooks: .venv/installed
	$(BIN)/python notebooks/execute.py --at-once 2

# They take half of the time of all.
LONG_NOTEBOOKS := 02_searches_and_error_tables.ipynb 04_rare_events.ipynb \
  05_safe_hyperparameters.ipynb 06_perception.ipynb 07_augmentation.ipynb 08_tempe.ipynb
notebooks-short: .venv/installed
	$(BIN)/python notebooks/execute.py --at-once 2 \
	  $(filter-out $(LONG_NOTEBOOKS), $(sort $(notdir $(wildcard notebooks/*.ipynb))))

notebooks-update: .venv/installed
	$(BIN)/python notebooks/execute.py --update

# The monitors to compare with pin old versions of what others use newer ones of, so they get an
# environment of their own, without the constraints.
.venv-bench/installed: pyproject.toml
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python -m pip install -q --disable-pip-version-check -e '.[bench]'
	@touch $@

bench: .venv-bench/installed .venv/extras
	.venv-bench/bin/python benchmarks/throughput.py
	.venv-bench/bin/python benchmarks/search_quality.py landscapes
	.venv-bench/bin/python benchmarks/search_quality.py cartpole
	.venv-bench/bin/python benchmarks/search_cost.py
	.venv-bench/bin/python benchmarks/monitor.py
	$(BIN)/python benchmarks/engine.py
	$(BIN)/python benchmarks/large_runs.py
	VERIFAI_JAX_CORES=1 $(BIN)/python benchmarks/executors.py
	$(BIN)/python benchmarks/contact_gradients.py
	$(BIN)/python benchmarks/remote.py
	$(BIN)/python benchmarks/perception.py frames
	$(BIN)/python benchmarks/perception.py loop
	$(BIN)/python benchmarks/road.py
	$(BIN)/python benchmarks/scenes.py

# Those that take under a minute each; benchmarks/CLAIMS.md has all of them.
claims: .venv/installed
	$(BIN)/python -m benchmarks.claims

policy: .venv/installed
	$(BIN)/python -m envs.train_cartpole
	$(BIN)/python -m envs.train_lane_keeping
	$(BIN)/python -m envs.train_hopper
	$(BIN)/python -m envs.train_cones

# The wheel must work away from the checkout, where there is no envs/ and no specs/. It is built from
# the source distribution, which is whole, then.
wheel: .venv/lint
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	sh tests/wheel_smoke.sh dist/*.whl

# For Pythons that are not here, too; then `.ci/run` on each.
constraints: .venv/lint
	$(BIN)/python -m pip install -q --disable-pip-version-check uv
	$(BIN)/python .ci/constraints.py $(VERSIONS)

clean:
	rm -rf .venv .venv-bench dist build .pytest_cache .ruff_cache
