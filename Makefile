# A newcomer needs only `make demo` and `make test`. The first one that is run sets up the virtual environment.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
READY = $(VENV)/.ready
# Python compiles a module when it is first imported; compiling all modules at installation would take longer.
unexport PYTHONDONTWRITEBYTECODE
PIP_INSTALL = -m pip install --quiet --disable-pip-version-check --no-compile

.PHONY: demo test test-slow lint docs docs-links bench experiment test-kilted test-lerobot test-oldest test-rllib test-wheel clean

demo: $(READY) ## Train PPO on MARA-v0, evaluate it, save a run folder under runs/.
	$(BIN)/gym-mara train --env MARA-v0 --algo ppo --steps 3e5

test: $(READY) ## Run the tests, but for the slow ones.
	$(BIN)/python -m pytest -n auto -m "not slow and not nightly" $(TESTS)

test-slow: $(READY) ## Run the slow tests: long trainings, Chromium, the examples.
	.ci/chromium
	$(BIN)/python -m pytest -n auto -m "slow and not nightly"

lint: $(READY) ## Check format, lint and types.
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

SPHINX = .venv-docs/bin/python -m sphinx -q -W --keep-going -c docs/site -d docs/_build/doctrees

docs: .venv-docs/.ready ## Build the site into docs/_build/html. A warning is an error, and so is a link to a page or heading that is not there.
	$(SPHINX) -b html docs docs/_build/html

docs-links: .venv-docs/.ready ## Look up the site's links to other sites, which needs a network.
	$(SPHINX) -b linkcheck docs docs/_build/links

bench: ## Measure speed. The other packages that it compares with pin an older MuJoCo, hence a separate virtual environment.
	$(MAKE) .venv-bench/.ready VENV=.venv-bench EXTRAS=bench
	.venv-bench/bin/python benchmarks/speed.py
	.venv-bench/bin/python benchmarks/dynamics.py
	.venv-bench/bin/python benchmarks/rendering.py

experiment: $(READY) ## Repeat the paper's experiment: three algorithms, four environments, three seeds; a quarter of an hour on two cores.
	$(BIN)/gym-mara benchmark --out runs/experiment

test-oldest: .venv-oldest/.ready ## Run the tests of environments, pictures and Stable-Baselines3 with the oldest supported Gymnasium.
	.venv-oldest/bin/python -m pytest -n auto -m "not slow and not nightly" $(GYMNASIUM_TESTS)

test-kilted: .venv-kilted/.ready ## Run the tests that speak ROS 2 with the wheels of Kilted; all others use those of Jazzy.
	.venv-kilted/bin/python -m pytest -n auto -m "not nightly" $(ROS_TESTS)

test-lerobot: .venv-lerobot/.ready ## Read recorded data sets with LeRobot's own loader; LeRobot and its CUDA take gigabytes, so CI does not.
	rm -rf .venv-lerobot/sets && mkdir .venv-lerobot/sets
	$(BIN)/gym-mara record --policy ik --env MARAReach-v0 --format lerobot --episodes 60 --out .venv-lerobot/sets/reach
	$(BIN)/gym-mara record --policy ik --env MARAGoal-v0 --format lerobot --episodes 3 --pixels 64 --out .venv-lerobot/sets/goal
	for set in reach goal; do HF_HUB_OFFLINE=1 .venv-lerobot/bin/python tests/datasets/read_with_lerobot.py .venv-lerobot/sets/$$set || exit 1; done

test-rllib: .venv-rllib/.ready ## Run the RLlib example, which pins an older Gymnasium, with that one.
	.venv-rllib/bin/python examples/rllib_ppo.py --steps 600

test-wheel: ## Build the wheel, install it outside the checkout, and use every environment there.
	.ci/test-wheel $(PYTHON)

clean: ## Remove the virtual environments and the files of the tools.
	rm -rf docs/_build .venv .venv-bench .venv-docs .venv-kilted .venv-lerobot .venv-oldest .venv-rllib build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis

CONSTRAINTS ?= constraints.txt
EXTRAS ?= dev
TESTS ?=
# The others need no ROS.
ROS_TESTS = $(addprefix tests/ros2/,sim bags/test_recording.py test_check.py test_faults.py test_link.py test_node.py)
# Another Gymnasium changes nothing in the others.
GYMNASIUM_TESTS = $(addprefix tests/,$(addprefix envs/,actions $(patsubst %,test_%.py,drawn_starts dynamics given goal simulation single snapshots statistics vector)) \
	test_gym_gazebo2.py test_registration.py test_robot_options.py rendering/test_pictures.py agents/test_sb3.py)

$(READY): pyproject.toml $(CONSTRAINTS)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python $(PIP_INSTALL) -c $(CONSTRAINTS) -e '.[$(EXTRAS)]'
	touch $@

# What replaces a library of $(VENV) is installed here. All other packages are those of $(VENV). The name of the file that says so
# is the last one, so that what is installed here comes first.
PACKAGES = 'import sysconfig; print(sysconfig.get_path("purelib"))'
define OTHERS_FROM_VENV
	others=$$($(BIN)/python -c $(PACKAGES)); \
	echo "import site; site.addsitedir('$$others')" >$$($(@D)/bin/python -c $(PACKAGES))/zz_others.pth
endef

.venv-oldest/.ready: $(READY) constraints-oldest.txt
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) --no-deps -r constraints-oldest.txt
	$(OTHERS_FROM_VENV)
	$(@D)/bin/python -c 'import gymnasium; assert gymnasium.__version__.startswith("1.1."), gymnasium.__version__'
	touch $@

.venv-docs/.ready: $(READY) $(CONSTRAINTS)
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) -c $(CONSTRAINTS) furo myst-parser sphinx
	$(OTHERS_FROM_VENV)
	touch $@

# What ray[rllib] adds to ray, and the Gymnasium that it pins.
.venv-rllib/.ready: $(READY)
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) --no-deps gymnasium==1.2.2 ormsgpack pyarrow tensorboardX
	$(OTHERS_FROM_VENV)
	touch $@

# LeRobot pins versions of torch, packaging and others that are not those of $(VENV), and reads the files alone.
.venv-lerobot/.ready:
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) lerobot==0.4.4
	touch $@

.venv-kilted/.ready: $(READY)
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) ros-kilted-rclpy==9.1.2 ros-rmw-fastrtps-cpp==9.3.3 ros-kilted-common-interfaces==5.5.1
	$(OTHERS_FROM_VENV)
	$(@D)/bin/python -c 'import rclpy, sys; assert rclpy.__file__.startswith(sys.prefix), rclpy.__file__'
	touch $@
