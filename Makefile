# `make test` and `make demo` need git, make and Python 3.10 to 3.13, nothing else: what is missing goes into .venv.
# Where a ROS 2 is sourced (ROS_DISTRO), it is used; elsewhere its wheels are installed (x86-64 Linux only).

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ROS := $(or $(ROS_DISTRO),wheels)

# Stamps of their own for each ROS, so that a change of it is noticed.
DEPENDENCIES := $(VENV)/.dependencies-$(ROS)
INSTALLED := $(VENV)/.installed-$(ROS)
SOURCES := package.xml $(shell find gyro_calibration config launch lib -type f -not -name '*.pyc')
TIMED := $(BIN)/python -m pytest -m timed -o cache_dir=$(VENV)/timed
FAILED := $(VENV)/timed/v/cache/lastfailed
PIP := $(BIN)/python -m pip --disable-pip-version-check install -qq

# Nothing that runs here is heard on the network, and launch finds the package in .venv.
export ROS_AUTOMATIC_DISCOVERY_RANGE := LOCALHOST
test demo: export AMENT_PREFIX_PATH := $(CURDIR)/$(VENV)$(if $(AMENT_PREFIX_PATH),:$(AMENT_PREFIX_PATH))

.PHONY: test style timed beside alone computing demo build clean

# What one finds does not keep the others from running, so that one run says everything.
test: $(INSTALLED)
	@$(MAKE) --no-print-directory --keep-going --jobs 2 style alone

style:
	@$(BIN)/python -m ruff check --quiet --output-format concise .; style=$$?; \
	$(BIN)/python -m mypy --no-error-summary gyro_calibration && exit $$style

timed:
	@$(TIMED)

# beside the tests of processes that have to keep time, and after them where both want the processor
computing:
	@nice -n 19 $(BIN)/python -m pytest -m 'not timed' > $(VENV)/computing.txt 2>&1; code=$$?; cat $(VENV)/computing.txt; exit $$code

# A test that has to keep time may fail where the machine lets it wait for seconds. So what fails beside other tests is told, but decided
# alone, when they are done. Where more than ten fail, it is not the machine.
beside:
	@rm -rf $(VENV)/timed
	@$(TIMED) || [ $$? = 1 ]

alone: beside computing
	@[ ! -e $(FAILED) ] || { echo 'Once more, alone, what failed and has to keep time:'; \
	[ $$(grep -c :: $(FAILED)) -le 10 ] && $(TIMED) --last-failed; }

demo: $(INSTALLED)
	@$(BIN)/gyro_calibration demo --out demo

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

# Not editable, because that installs neither configuration nor launch files; so each change of a source is installed anew, in seconds.
# What setuptools leaves in build would bring removed modules back.
$(INSTALLED): $(DEPENDENCIES) $(SOURCES)
	@echo 'Installing gyro_calibration into $(VENV) ...'
	@rm -rf build/lib build/bdist.*
	@$(PIP) --no-deps --no-build-isolation .
	@touch $@
