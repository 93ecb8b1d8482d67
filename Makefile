# make demo and make test are all that a newcomer needs; each sets up what it needs, once.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready
# What is imported is compiled then, and kept; most of what is installed never is.
unexport PYTHONDONTWRITEBYTECODE
PIP_INSTALL = -m pip install --quiet --disable-pip-version-check --no-compile

.PHONY: demo test lint bench experiment test-oldest test-rllib test-wheel clean

demo: $(READY) ## Train PPO on MARA-v0, evaluate it, leave a run folder under runs/.
	$(BIN)/gym-mara train --env MARA-v0 --algo ppo --steps 3e5

test: $(READY) ## Run the tests, some of them in Chromium.
	.ci/chromium
	$(BIN)/python -m pytest -n auto $(TESTS)

lint: $(READY) ## Check format, lint and types.
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: ## Measure speed against the floor and against peers, which pin an older MuJoCo, in an environment of its own.
	$(MAKE) .venv-bench/.ready VENV=.venv-bench EXTRAS=bench
	.venv-bench/bin/python benchmarks/speed.py
	.venv-bench/bin/python benchmarks/dynamics.py
	.venv-bench/bin/python benchmarks/rendering.py

experiment: $(READY) ## Repeat the paper's experiment: three algorithms, four environments, three seeds; most of an hour.
	$(BIN)/gym-mara benchmark --out runs/experiment

test-oldest: ## Run the tests of all that Gymnasium calls, with the oldest that is supported.
	$(MAKE) test VENV=.venv-oldest EXTRAS=test CONSTRAINTS=constraints-oldest.txt TESTS="$(GYMNASIUM_TESTS)"

test-rllib: ## Run the example of RLlib, which pins an older Gymnasium, in an environment of its own.
	$(MAKE) .venv-rllib/.ready VENV=.venv-rllib EXTRAS=rllib
	.venv-rllib/bin/python examples/rllib_ppo.py --steps 600

test-wheel: ## Build the wheel, install it away from the checkout, and use every environment from there.
	.ci/test-wheel $(PYTHON)

clean: ## Remove the virtual environments and what the tools left.
	rm -rf .venv .venv-bench .venv-oldest .venv-rllib build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

CONSTRAINTS ?= constraints.txt
EXTRAS ?= dev
TESTS ?=
GYMNASIUM_TESTS = $(filter-out tests/test_examples.py,$(wildcard tests/test_*.py)) tests/envs tests/rendering/test_pictures.py tests/agents/test_sb3.py

$(READY): pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python $(PIP_INSTALL) -c $(CONSTRAINTS) -e '.[$(EXTRAS)]'
	touch $@
