# Copyright 2026 The kfvo_ros authors
# SPDX-License-Identifier: Apache-2.0
#
# Virtual environment, tests, benchmarks and demo; the system's Python is never changed.

SHELL := /bin/sh
KFVO_DATA ?= ../shared/data
unexport KFVO_DATA
comma := ,

# A sourced ROS has its own rclpy, Python and numpy; elsewhere the `ros` extra installs wheels,
# which exist for Linux on x86-64 only.
ifneq ($(ROS_DISTRO),)
CONSTRAINTS ?= constraints-jazzy.txt
CANDIDATES := python3
VENV_OPTIONS := --system-site-packages
ROS :=
else
CONSTRAINTS ?= constraints.txt
CANDIDATES := python3.13 python3.12 python3.11 python3.10 python3
ROS := $(if $(findstring Linux x86_64,$(shell uname -sm)),ros$(comma))
endif

# One environment per constraints file: .venv, .venv-jazzy, and -ros of each with a sourced ROS.
PINS := $(basename $(notdir $(CONSTRAINTS)))
VENV := .venv$(PINS:constraints%=%)$(if $(ROS_DISTRO),-ros)
INSTALLED := $(VENV)/.installed
TOOLS := $(VENV)/.tools
PIP_INSTALL = $(VENV)/bin/python -m pip install --quiet --disable-pip-version-check \
	--constraint $(CONSTRAINTS) --editable
NEWEST := $(if $(findstring jazzy,$(CONSTRAINTS)),12,13)

# The first candidate that runs and is new enough, but not newer than the pinned wheels.
SUPPORTED := import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, $(NEWEST)))
ifndef PYTHON
PYTHON := $(shell for python in $(CANDIDATES); do \
	$$python -c '$(SUPPORTED)' 2>/dev/null && echo $$python && break; done)
endif

# Sequences of docs/results.md: the datasets found in KFVO_DATA, by paths relative to it, and
# rendered ones.
MARKS := mav0 rgb.txt times.txt pose_left.txt
FOUND = $(foreach mark,$(MARKS),$(foreach depth,* */* */*/* */*/*/*,\
	$(wildcard $(KFVO_DATA)/$(depth)/$(mark))))
SEQUENCES ?= $(patsubst $(KFVO_DATA)/%/,%,$(sort $(dir $(FOUND)))) \
	synthetic:0-2:street synthetic:0-2:smooth synthetic:0-2:fast
POLICY ?=
OPTIONS ?= --seeds 0,1,2
FAULTS ?=

.PHONY: help demo bench-node bench-train bench-vggt faults results test lint clean

help:
	@echo 'make demo    a rendered sequence through kfvo_node, over DDS, into demo/'
	@echo 'make test    install into $(VENV) and run ruff, mypy and the tests'
	@echo 'make bench-node   a minute of 752x480 at 20 Hz, then at twice what the node can take'
	@echo 'make bench-train  decisions per second of the environment, and of PPO'
	@echo 'make bench-vggt   a step of the VGGT backbone, in full and with reuse'
	@echo 'make faults  damaged files, signals, kills, full disks (docs/faults.md); 20 minutes;'
	@echo '             FAULTS="--only mcap,png --tries 50": some of them'
	@echo 'make results  docs/results.md: all methods on KFVO_DATA, rooms and streets; POLICY=FILE: a'
	@echo '              learned one too. It goes on where it was interrupted'
	@echo 'make lint    ruff and mypy'
	@echo 'make clean   remove the environments and all that was built'
	@echo
	@echo 'CONSTRAINTS=$(CONSTRAINTS)  exact versions; constraints-jazzy.txt has numpy 1.26'
	@echo 'KFVO_DATA=$(KFVO_DATA)  sequences for the tests that want some'
	@echo 'PYTHON=$(PYTHON)  Python 3.10 to 3.$(NEWEST)'

demo: $(INSTALLED)
	$(VENV)/bin/python -m kfvo_ros.demo --output demo

bench-node: $(INSTALLED)
	$(VENV)/bin/python benchmarks/node.py

bench-train: $(TOOLS)
	$(VENV)/bin/python benchmarks/training.py

bench-vggt: $(TOOLS)
	$(VENV)/bin/python benchmarks/vggt.py --size 168x224

faults: $(TOOLS)
	$(VENV)/bin/python -m benchmarks.faults $(FAULTS)

results: $(TOOLS)
	cd '$(or $(wildcard $(KFVO_DATA)),.)' && '$(CURDIR)/$(VENV)/bin/python' -m \
		kfvo_ros.benchmark $(SEQUENCES) $(OPTIONS) --resume --output '$(CURDIR)/results' \
		$(if $(POLICY),--policy '$(abspath $(POLICY))')
	cp results/results.md results/trajectories.png results/errors.png docs/

test: lint
	[ ! -d '$(KFVO_DATA)' ] || export KFVO_DATA="$$(cd '$(KFVO_DATA)' && pwd)"; \
	PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(VENV)/bin/python -m pytest -rs \
		-p xdist -n 2 --dist loadgroup

lint: $(TOOLS)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

$(INSTALLED): setup.py pyproject.toml $(CONSTRAINTS)
	@test -n '$(PYTHON)' || { echo 'No Python 3.10 to 3.$(NEWEST) found among: $(CANDIDATES).' \
		'Install one, or name it: make test PYTHON=/path/to/python3' >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
		echo '$(PYTHON) cannot make virtual environments: apt install python3-venv' >&2; exit 1; }
	$(PYTHON) -m venv --clear $(VENV_OPTIONS) $(VENV)
	$(PIP_INSTALL) '.[$(ROS)demo]'
	@touch $@

$(TOOLS): $(INSTALLED)
	$(PIP_INSTALL) '.[$(ROS)demo,test,train,vggt]'
	@touch $@

clean:
	rm -rf .venv* build install log demo faults results *.egg-info .pytest_cache .ruff_cache .mypy_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
