# `make test` and `make demo` need git, make and Python 3.10 to 3.14, nothing else: what is missing
# goes into .venv. Where a ROS 2 is sourced (ROS_DISTRO), it is used; elsewhere its wheels are
# installed (x86-64 Linux only).

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ROS := $(or $(ROS_DISTRO),wheels)

# Stamps of their own for each ROS, so that a change of it is noticed.
DEPENDENCIES := $(VENV)/.dependencies-$(ROS)
INSTALLED := $(VENV)/.installed-$(ROS)
SOURCES := package.xml $(shell find gyro_calibration gyro_calibration_bench gyro_calibration_reproduction config samples launch bin lib \
                                   -type f -not -name '*.pyc')
PYTEST := $(BIN)/python -m pytest
PIP := $(BIN)/python -m pip --disable-pip-version-check install -qq

# Tests that were compiled are kept, whatever the shell says: four processes compile them.
unexport PYTHONDONTWRITEBYTECODE

# Nothing that runs here is heard on the network, and launch finds the package in .venv.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
test timed evidence demo: export AMENT_PREFIX_PATH := $(CURDIR)/$(VENV)$(if $(AMENT_PREFIX_PATH),:$(AMENT_PREFIX_PATH))

.PHONY: test style timed computing evidence demo docs build clean

# What one finds does not keep the others from running, so that one run says everything.
test: $(INSTALLED)
	@$(MAKE) --no-print-directory --keep-going --jobs 3 style timed computing

# what ROS reviewers run (flake8 with the plugins and settings of ament), ruff and mypy
style:
	@code=0; \
	$(BIN)/python -m ruff check --quiet --output-format concise . || code=1; \
	$(BIN)/python -m flake8 || code=1; \
	$(BIN)/python -m mypy --no-error-summary gyro_calibration gyro_calibration_bench gyro_calibration_reproduction || code=1; \
	exit $$code

# what has to keep time: nodes, ports
timed:
	@$(PYTEST) -m timed

# all other tests, which give way to those
computing:
	@nice -n 19 $(PYTEST) -m 'not timed' -n 2 --dist loadfile --no-loadscope-reorder \
		> $(VENV)/computing.txt 2>&1; code=$$?; \
	cat $(VENV)/computing.txt; exit $$code

# what takes long: coverage by hundreds of simulated drives, fuzzing, soak
evidence: $(INSTALLED)
	@$(PYTEST) -m evidence

demo: $(INSTALLED)
	@$(BIN)/gyro_calibration demo --out demo
	@echo 'How to go on: `. $(BIN)/activate` puts the program gyro_calibration on the PATH (it is'
	@echo '$(BIN)/gyro_calibration); then see docs/tutorials/robot.md, or the picture demo/heading.png.'

# the pages as a site, in build/docs; a warning is an error
docs: $(INSTALLED) $(VENV)/.docs
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo 'build/docs/index.html'

$(VENV)/.docs: $(DEPENDENCIES)
	@$(PIP) '.[docs]'
	@touch $@

build: $(INSTALLED)
	@PATH="$(CURDIR)/$(BIN):$$PATH" colcon build --event-handlers console_direct-

clean:
	rm -rf $(VENV) build install log demo *.egg-info .pytest_cache .ruff_cache .mypy_cache

$(DEPENDENCIES): setup.py
ifdef ROS_DISTRO
	@echo 'Setting up $(VENV) beside ROS 2 $(ROS_DISTRO) ...'
	@$(PYTHON) -m venv --clear --system-site-packages $(VENV)
	@$(PIP) '.[plot,test]'
else
	@echo 'Setting up $(VENV) with ROS 2 from wheels, 400 MB, about a minute ...'
	@$(PYTHON) -m venv --clear $(VENV)
	@$(PIP) '.[ros,plot,test]'
endif
	@touch $@

# Not editable, because that installs neither configuration nor launch files; so each change of a
# source is installed anew, in seconds. What setuptools leaves in build would bring removed modules
# back.
$(INSTALLED): $(DEPENDENCIES) $(SOURCES)
	@echo 'Installing gyro_calibration into $(VENV) ...'
	@rm -rf build/lib build/bdist.*
	@$(PIP) --no-deps --no-build-isolation .
	@touch $@
