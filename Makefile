# make help says what there is. Nothing is needed but Python (with venv) and make: what is
# installed goes into .venv.

PYTHON ?= python3
# The ROS 2 distribution, jazzy or kilted: each has its own environment.
ROS ?= jazzy
VENV ?= .venv$(if $(filter-out jazzy,$(ROS)),-$(ROS))
# Passed to the command or to pytest, as in: make demo ARGS='--out /tmp/demo --json'
ARGS ?=
# For make constraints and make release.
PYTHONS ?= python3.10 python3.11 python3.12 python3.13 python3.14

BIN := $(VENV)/bin
PYTEST := $(BIN)/python -m pytest -n auto --dist loadgroup --no-loadscope-reorder
# Bytecode is written when a module is first imported, not for all of them now.
INSTALL := $(BIN)/python scripts/narrate.py $(BIN)/python -m pip install --disable-pip-version-check --no-compile \
	-c constraints$(if $(filter-out jazzy,$(ROS)),-$(ROS)).txt
# Of the package that is installed: to install it again would compile the motion again.
EXTRAS := $(BIN)/python scripts/list_extras.py

# The environment brings its own ROS: one that the calling shell has sourced is set aside, and
# what it selects (middleware, profiles, security) with it.
unexport PYTHONPATH PYTHONHOME PYTHONWARNINGS PYTHONDONTWRITEBYTECODE
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH
unexport ROS_DISTRO ROS_VERSION ROS_PYTHON_VERSION ROS_LOCALHOST_ONLY ROS_STATIC_PEERS
unexport ROS_DISCOVERY_SERVER ROS_SECURITY_ENABLE ROS_SECURITY_STRATEGY ROS_SECURITY_KEYSTORE
unexport RMW_IMPLEMENTATION CYCLONEDDS_URI
unexport FASTDDS_DEFAULT_PROFILES_FILE FASTRTPS_DEFAULT_PROFILES_FILE
unexport RCUTILS_CONSOLE_OUTPUT_FORMAT RCUTILS_LOGGING_USE_STDOUT
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

.PHONY: help
help: ## list the targets (default)
	@sed -n 's/^\([a-z]*\):.*## /\1	/p' $(MAKEFILE_LIST) | expand -t 14
	@echo "Variables: PYTHON=$(PYTHON) ROS=$(ROS) VENV=$(VENV) ARGS='$(ARGS)'"

.PHONY: demo
demo: env ## run the demonstration
	$(BIN)/hmsa demo $(ARGS)

.PHONY: test
test: tools ## run the tests, in parallel
	$(PYTEST) -m 'not thorough and not slow and not lint' $(ARGS)

.PHONY: thorough
thorough: tools ## run the tests of feedback, identification and modes that compute for long
	$(PYTEST) -m 'thorough and not slow' $(ARGS)

.PHONY: full
full: tools ## run thorough and slow tests too, and random examples, as before a release
	$(PYTEST) -m 'not lint' --hypothesis-profile full $(ARGS)
	$(MAKE) actions

.PHONY: actions
actions: $(VENV)/.control_msgs tools ## build control_msgs, and test the action that needs it
	. $(CURDIR)/$(VENV)/control_msgs/setup.sh && $(PYTEST) test/test_follow.py $(ARGS)

.PHONY: check
check: tools ## run the tests that need no nodes
	$(PYTEST) -m 'not thorough and not slow and not lint and not ros' $(ARGS)

.PHONY: lint
lint: $(VENV)/.lint env ## check style and types: ruff, mypy and rules of this project
	$(BIN)/python -m ruff check .
	$(BIN)/python -m mypy
	$(BIN)/python -m pytest -q -m lint test/test_style.py

.PHONY: bench
bench: $(VENV)/.bench env ## measure speed and accuracy
	$(BIN)/python -m benchmarks $(ARGS)

.PHONY: figures
figures: env ## draw Figures 2 to 10 of the paper into figures/
	$(BIN)/hmsa figures --out figures $(ARGS)

.PHONY: docs
docs: tools ## build the documentation into docs/_build/html, warnings as errors
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html $(ARGS)
	@echo "docs/_build/html/index.html"

.PHONY: weight
weight: env ## print how large the packages are, and how far a setpoint travels through them
	$(BIN)/python scripts/weigh.py

.PHONY: graph
graph: tools ## redraw docs/images/graph.svg, when a topic has changed
	$(BIN)/python scripts/draw_graph.py

.PHONY: pictures
pictures: tools ## redraw the pictures of the documentation
	$(BIN)/python scripts/draw_docs.py $(ARGS)

.PHONY: release
release: env ## build sdist and wheels into dist/, and test them with each of $(PYTHONS)
	$(EXTRAS) release > $(VENV)/extras.txt
	$(INSTALL) -r $(VENV)/extras.txt
	$(BIN)/python scripts/make_release.py $(PYTHONS)

.PHONY: constraints
constraints: ## rewrite constraints.txt (with ROS=kilted, its own file), with each of $(PYTHONS)
	$(PYTHON) scripts/make_constraints.py $(ROS) $(PYTHONS)

.PHONY: clean
clean: ## remove the environment, builds and caches
	rm -rf $(VENV) build install log dist figures docs/_build *.egg-info
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.PHONY: env
env: $(VENV)/.motion ## make the environment

.PHONY: tools
tools: $(VENV)/.tools env ## make the environment, with what tests and documentation need

# The stamps come last in their recipes: an environment left half made has none and is made anew.
$(VENV)/.installed: setup.py setup.cfg pyproject.toml package.xml $(wildcard constraints*.txt)
	@$(PYTHON) -c 'import sys; sys.exit(0 if (3, 10) <= sys.version_info[:2] <= (3, 14) else 1)' \
	2>/dev/null || { echo "hmsa_ros: $(PYTHON) is $$($(PYTHON) --version 2>/dev/null || echo not a Python that" \
	"runs): expected Python 3.10 to 3.14; name one, as in: make PYTHON=python3.13" >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null \
	|| { echo "hmsa_ros: $(PYTHON) cannot make environments: expected its modules venv and" \
	"ensurepip; install them (on Debian and Ubuntu: python3-venv)" >&2; exit 1; }
	@$(PYTHON) -c 'import os, sysconfig as s; open(os.path.join(s.get_path("include"), "Python.h"))' \
	2>/dev/null || { echo "hmsa_ros: $(PYTHON) has no headers (Python.h): install them (on Debian and" \
	"Ubuntu: python3-dev)" >&2; exit 1; }
	@command -v c++ >/dev/null || { echo "hmsa_ros: no C++ compiler (c++): install one; on Debian" \
	"and Ubuntu: apt install g++" >&2; exit 1; }
	@echo "Making the environment $(VENV) with ROS 2 and all requirements: up to some minutes the first time"
	$(PYTHON) scripts/narrate.py $(PYTHON) -m venv --clear $(VENV)
	$(INSTALL) -e '.[$(ROS)]'
	@touch $@ $(VENV)/.motion

$(VENV)/.tools: $(VENV)/.installed
	$(EXTRAS) test sweep panel docs > $(VENV)/extras.txt
	$(INSTALL) -r $(VENV)/extras.txt
	@touch $@

# With the tools, since mypy reads the types of what is imported.
$(VENV)/.lint: $(VENV)/.tools
	$(EXTRAS) lint > $(VENV)/extras.txt
	$(INSTALL) -r $(VENV)/extras.txt
	@touch $@

$(VENV)/.bench: $(VENV)/.installed
	$(EXTRAS) bench sweep > $(VENV)/extras.txt
	$(INSTALL) -r $(VENV)/extras.txt
	@touch $@

# Apart from the environment, which is one without control_msgs.
$(VENV)/.control_msgs: $(wildcard test/action_interfaces/* test/action_interfaces/*/*) | $(VENV)/.installed
	test/action_interfaces/build.sh $(ROS) $(BIN)/python $(VENV)/control_msgs
	@touch $@

# The installation compiles the motion, too; this is for when its sources change.
$(VENV)/.motion: $(wildcard hmsa/*.c hmsa_lab/bench/*.cpp \
	hmsa_lab/bench/hmsa_board/*.hpp hmsa/judge/*.cpp hmsa/motion/*.[ch]pp hmsa/motion/hmsa/*.hpp) | $(VENV)/.installed
	@test -e $@ && test -z "$$(find $^ -newer $@)" \
	|| { echo "Compiling the motion"; $(BIN)/python scripts/narrate.py $(BIN)/python setup.py --quiet build_ext --inplace; }
	@touch $@

# An environment whose Python does not start (moved, or its base removed) is made anew too.
ifneq ($(shell $(BIN)/python -I -c 'print("starts")' 2>/dev/null),starts)
.PHONY: $(VENV)/.installed
endif
