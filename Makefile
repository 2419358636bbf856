# Installs into .venv from requirements.lock and requirements-dev.lock, whatever index pip is configured with.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.ONESHELL:
.DEFAULT_GOAL := help
# Without kept bytecode every process of the tests compiles all sources again.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv
PY := $(VENV)/bin/python
PYTHON ?= $(shell for p in python3 python3.11 python3.12 python3.13; do \
	"$$p" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && { echo "$$p"; break; }; done)
SOURCES := src configs drivers daq identify virtual_robot tests
PYTEST := $(PY) -m pytest
WITH_VCAN := $(PY) -m armident.drivers.vcan -n 2 --
# a worker that has finished takes tests from the other; shared results are on disk (tests/fixtures)
PARALLEL := -n auto --dist worksteal
LINT := $(PY) -m ruff check $(SOURCES) && $(PY) -m ruff format --check $(SOURCES) && $(PY) -m mypy && $(VENV)/bin/lint-imports

.PHONY: help install develop demo check quick test nightly off-bus on-bus coverage lint vcan suite reproduce docs bench lock sbom clean

help: ## what there is to do
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-9s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(PY):
	@if [ -z "$(PYTHON)" ]; then
		echo "armident needs Python 3.11 or later; an administrator must run: sudo apt-get install python3" >&2; exit 1
	fi
	if ! "$(PYTHON)" -c 'import ensurepip' 2>/dev/null; then
		if [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
			apt-get -q update && apt-get -qy install python3-venv
		else
			echo "Python's venv is not installed; an administrator must run: sudo apt-get install python3-venv" >&2; exit 1
		fi
	fi
	"$(PYTHON)" -m venv $(VENV)

# Two processes of pip, each with every second package. Bytecode is written at first use: half of it is never used.
define INSTALL
	mkdir -p .cache
	awk -v part=.cache/install '/^[^ #]/ {k++} {print > (part (k % 2))}' $(1)
	for k in 0 1; do
		$(PY) -m pip install -qq --disable-pip-version-check --no-compile --no-deps --require-hashes -r .cache/install$$k & pids[k]=$$!
	done
	wait $${pids[0]}; wait $${pids[1]}
endef

$(VENV)/.lock: requirements.lock | $(PY)
	@echo "installing what requirements.lock lists into $(VENV) (a minute or two)"
	$(call INSTALL,$<)
	touch $@

$(VENV)/.dev: requirements-dev.lock | $(VENV)/.lock
	@echo "installing what requirements-dev.lock lists into $(VENV) (a minute)"
	$(call INSTALL,$<)
	touch $@

$(VENV)/.project: pyproject.toml setup.py $(VENV)/.lock
	@$(PY) -m pip install -qq --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

# Compiled where a module with kernels has changed; an edit elsewhere that changes a kernel is seen when it is called.
$(VENV)/.kernels: $(VENV)/.project $(shell grep -rl --include=*.py 'from armident.compiled import' $(filter-out tests,$(SOURCES)))
	@$(PY) -m armident.compiled
	touch $@

install: $(VENV)/.kernels ## install into .venv what runs armident, and compile its kernels

develop: install $(VENV)/.dev ## install also what checks, tests and documentation need

demo: install ## the whole story on this machine, ends with a report (DEMO="--out DIR" passes options)
	@$(VENV)/bin/armident demo $(DEMO)

lint: develop
	@$(LINT)

check: develop ## ruff, mypy, import-linter and the quick tests, side by side
	@$(MAKE) --no-print-directory -k -j2 lint quick

quick:
	@$(PYTEST) -q $(PARALLEL) -m "not vcan and not slow and not nightly"

test: develop ## everything but the nightly tests, those on vcan included
	@$(MAKE) --no-print-directory -k -j3 NAME=tests SELECTED="not nightly" on-bus lint off-bus && failed= || failed=1
	echo
	echo "Skipped, or failing as expected:"
	grep -hE '^(SKIPPED|XFAIL)' .cache/tests.log .cache/tests-vcan.log || echo "nothing"
	if [ -n "$$failed" ]; then echo "FAILED: see above, .cache/tests.log and .cache/tests-vcan.log"; exit 1; fi

# Hypothesis marks its own tests; the profile (tests/conftest.py) has more examples of each.
nightly: develop ## faults, kills, oddities, statistics, pages, the wheel; many examples of each property (tests/README.md)
	@export ARMIDENT_HYPOTHESIS_PROFILE=nightly
	$(MAKE) --no-print-directory -k -j2 NAME=nightly SELECTED="nightly or hypothesis" off-bus on-bus

# The parts of test and nightly, side by side. The guest has one CPU and its buses run in real time: it goes first.
off-bus:
	@mkdir -p .cache
	nice -n 10 $(PYTEST) $(PARALLEL) -m "not vcan and ($(SELECTED))" 2>&1 | tee .cache/$(NAME).log

on-bus:
	@mkdir -p .cache
	bus=
	if $(PY) -m armident.drivers.vcan -n 2 --setup; then bus="$(WITH_VCAN)"; fi
	$$bus $(PYTEST) -o cache_dir=.cache/pytest-vcan -m "vcan and ($(SELECTED))" tests/integration \
		>.cache/$(NAME)-vcan.log 2>&1 && failed= || failed=1
	cat .cache/$(NAME)-vcan.log
	[ -z "$$failed" ]

coverage: develop ## lines and branches that the tests off the bus run, by file; .cache/line-coverage/html has every line
	@mkdir -p .cache/line-coverage
	$(PYTEST) -q $(PARALLEL) -m "not vcan and not nightly" --cov --cov-branch \
		--cov-report=term:skip-covered --cov-report=html:.cache/line-coverage/html --cov-report=json:.cache/line-coverage/total.json
	$(PY) -m tests.tools.line_coverage .cache/line-coverage/total.json

vcan: install ## fetch what the vcan guest needs, where this kernel has no SocketCAN
	@$(PY) -m armident.drivers.vcan --setup

suite: install ## hide effects in virtual arms and count what is found (SUITE="--quick" passes options), two hours
	@$(PY) -m tests.evaluation $(SUITE)

reproduce: install ## the tables of the thesis beside ours (REPRODUCE="--quick" passes options)
	@$(PY) -m tests.reproduction $(REPRODUCE)

docs: develop ## the documentation as a site, .cache/site/index.html
	@$(PY) -m sphinx -q -W --keep-going -b html docs .cache/site
	echo "site: .cache/site/index.html"

bench: develop ## figures of ours beside those of named alternatives
	@$(PY) -m tests.benchmarks.run

lock: install ## write both lock files anew from the ranges in pyproject.toml
	@$(PY) -m pip install -qq --disable-pip-version-check uv
	compile() { $(VENV)/bin/uv pip compile --universal --python-version 3.11 --generate-hashes --no-header --no-annotate -q "$$@"; }
	compile --upgrade --extra dev -o .cache/all.lock pyproject.toml
	echo "setuptools>=77" | compile --extra all -c .cache/all.lock -o requirements.lock pyproject.toml -
	awk 'NR == FNR {have[$$1]; next} /^[^ ]/ {keep = !($$1 in have)} keep' requirements.lock .cache/all.lock >requirements-dev.lock

sbom: develop ## bill of materials (CycloneDX) of the wheel with all extras, dist/armident.cdx.json
	@mkdir -p dist
	$(VENV)/bin/cyclonedx-py requirements --pyproject pyproject.toml --mc-type library --output-reproducible \
		-o dist/armident.cdx.json requirements.lock
	echo "bill of materials: dist/armident.cdx.json"

clean: ## remove what make and the tools created
	@rm -rf $(VENV) .cache src/armident/kernels .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache *.egg-info build dist out demo suite reproduction
