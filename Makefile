# Everything runs from a virtual environment that `make` creates in .venv. It needs Python 3.11-3.13
# with pip and venv, and a package index that pip can reach.

PYTHON ?= python3
PYTEST_ARGS ?= -n 2 --dist loadfile --no-loadscope-reorder
LOCK_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
UV := .venv-lock/bin/uv
UV_VERSION := 0.13.8

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo figures study bench-first coverage engines test test-all test-newer-jax defects fuzz lint docs dist format lock clean

help: ## List the targets
	@awk 'BEGIN { FS = ":.*## " } /^[a-z-]+:.*## / { printf "  %-10s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

demo: $(STAMP) ## Compare the gradient estimators on the pusher, into results/pusher
	$(BIN)/mjx-study compare pusher --output results/pusher

figures: $(STAMP) ## Regenerate the smaller figures and the films of docs/
	$(BIN)/mjx-study compare pusher --output results/pusher && cp results/pusher/comparison.png docs/pusher.png
	$(BIN)/mjx-study landscape momentum_transfer --contact penalty,mujoco_default,smooth_onset --output results/onset
	cp results/onset/landscape.png docs/onset.png
	$(BIN)/mjx-study optimise pusher --contact penalty --stiffness 1000 --seeds 3 --output results/optimisation
	cp results/optimisation/descent.png docs/optimisation.png
	$(BIN)/python -m experiments.figures
	$(BIN)/mjx-study rollout ball_wall --theta 0.75 --stiffness 1e4 --slow 2
	for task in momentum_transfer tennis double_pendulum; do $(BIN)/mjx-study rollout $$task || exit; done
	for task in ball_wall momentum_transfer tennis double_pendulum; do \
		cp results/$$task-rollout/rollout.gif docs/film_$$task.gif || exit; done

FAMILIES := penalty,mujoco,mujoco_stiff
ROBOTS := --contact penalty,mujoco,smooth_onset --samples 1000 --reference-samples 20000
SWEEP := $(BIN)/mjx-study sweep
study: $(STAMP) ## Sweep stiffness for the README's figures (half an hour; resumable)
	$(SWEEP) pusher --contact $(FAMILIES) --stiffness 10:1e4:13:log --seeds 10 --output results/variance
	$(SWEEP) momentum_transfer --contact penalty,mujoco,smooth_onset --stiffness 1e3:1e5:5:log --reference-samples 3000 --seeds 10 --output results/bias
	$(SWEEP) gripper --stiffness 300,1000,3000 $(ROBOTS) --seeds 10 --output results/bias_gripper
	$(SWEEP) landing --stiffness 1e3,3e3,1e4 $(ROBOTS) --seeds 10 --output results/bias_landing
	$(SWEEP) pusher --contact $(FAMILIES) --stiffness 10:1e4:7:log --iterations 500 --samples 10 --seeds 5 --output results/achieved
	$(SWEEP) pusher --contact $(FAMILIES) --stiffness 10:1e4:9:log --sigma 0.01:1:5:log --seeds 3 --output results/map
	for figure in variance bias bias_gripper/bias bias_landing/bias achieved map/map_stiffness_sigma; do \
		folder=$${figure%/*}; $(BIN)/mjx-study plot results/$$folder --format png || exit; \
		cp results/$$folder/$${figure#*/}.png docs/$$folder.png || exit; done

bench-first: $(STAMP) ## Measure how long first answers take, into docs/performance.md (five minutes)
	$(BIN)/python -m experiments.first_answers --page docs/performance.md

coverage: $(STAMP) ## Measure the tables of docs/coverage.md (a few minutes)
	$(BIN)/python -m experiments.coverage

engines: $(STAMP) ## Measure what docs/engines.md lacks, in pinned environments (hours; resumable; QUICK=1: a scene, in minutes)
	-$(BIN)/python -m experiments.engines.install
	$(BIN)/python -m experiments.engines $(if $(QUICK),--quick); failed=$$?; $(if $(QUICK),,\
		$(BIN)/python -m experiments.engines page && $(BIN)/python -m experiments.engines.figure && )exit $$failed

test: $(STAMP) ## Run the tests except slow ones (PYTEST_ARGS='-k name' replaces the two workers)
	$(BIN)/python -m pytest $(PYTEST_ARGS)

test-all: $(STAMP) ## Run all tests, and those of test-newer-jax
	$(BIN)/python -m pytest -m '' $(PYTEST_ARGS)
	$(MAKE) --no-print-directory test-newer-jax

# The lock serves Python 3.11, for which JAX ends at 0.10: the newest JAX that pyproject.toml allows needs a newer Python.
NEWER_PYTHON ?= $(shell for each in python3.13 python3.12 $$HOME/.pyenv/versions/3.1[32].*/bin/python; do \
	$$each -c '' 2>/dev/null && echo $$each && break; done)
NEWEST := .venv-newest
NEWEST_TESTS := compiled.py graph.py objective.py batches.py bench.py means.py optimise.py cluster.py
test-newer-jax: ## Run the tests of devices on the newest JAX, if there is a Python 3.12 or 3.13 (NEWER_PYTHON=path)
	@python=$(NEWER_PYTHON); if [ -z "$$python" ]; then \
		echo 'NOT TESTED on the newest JAX: no Python 3.12 or 3.13 here; NEWER_PYTHON=path names one'; else \
		{ test -x $(NEWEST)/bin/pip || $$python -m venv $(NEWEST); } && \
		$(NEWEST)/bin/python -m pip install --quiet --disable-pip-version-check -e '.[cluster]' 'jax>=0.11' \
			pytest pytest-xdist hypothesis beartype && \
		$(NEWEST)/bin/python -c 'import jax; print("JAX", jax.__version__)' && \
		$(NEWEST)/bin/python -m pytest -p no:cacheprovider $(PYTEST_ARGS) $(addprefix tests/test_,$(NEWEST_TESTS)); fi

defects: $(STAMP) ## Plant defects one at a time, and report in docs/testing.md what catches each (a quarter of an hour)
	$(BIN)/python -m tests.planted --everything --page docs/testing.md

fuzz: $(STAMP) ## Answer thousands of hostile inputs, and report in docs/testing.md (ten minutes)
	$(BIN)/python -m tests.fuzz --page docs/testing.md

lint: $(STAMP) ## Check style, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright

docs: $(STAMP) ## Build the site into build/site; a dead link or a faulty docstring is an error (half a minute)
	$(BIN)/python -m tools.site

dist: $(STAMP) ## Build sdist and wheel into dist, and check their contents
	rm -rf dist
	$(BIN)/check-manifest --no-build-isolation
	$(BIN)/python -m build --no-isolation
	$(BIN)/twine check --strict dist/*
	rm -rf build/wheel
	$(BIN)/python -m pip install --quiet --no-deps --target build/wheel dist/*.whl
	cd build/wheel && PYTHONPATH= $(CURDIR)/$(BIN)/python -m mjx_study tasks
	cd build/wheel && PYTHONPATH= $(CURDIR)/$(BIN)/python -c 'import mjx_study as m; [m.make_task(name) for name in m.TASKS]'

format: $(STAMP) ## Fix imports and formatting
	$(BIN)/ruff check --fix-only .
	$(BIN)/ruff format .

lock: $(UV) ## Update requirements.lock from pyproject.toml (LOCK_ARGS=--upgrade renews the pins)
	$(UV) pip compile --universal --python-version 3.11 --fork-strategy fewest --extra dev \
		--generate-hashes --no-emit-index-url --no-emit-find-links \
		--custom-compile-command 'make lock' --quiet $(LOCK_ARGS) pyproject.toml -o requirements.lock

clean: ## Remove environments, caches and builds, but not results/
	rm -rf $(VENV) .venv-lock .venv-newest build dist .cache *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Every file that pip installs here is pinned by its hash: the build backend comes from the lock as well.
$(STAMP): requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; v = sys.version_info[:2]; (3, 11) <= v <= (3, 13) or sys.exit("mjx-study needs Python 3.11-3.13, this is %d.%d: set PYTHON" % v)'
	test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

# Apart from .venv, which is made from the lock: a lock that does not install can still be renewed.
$(UV):
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)
