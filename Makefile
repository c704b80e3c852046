# make demo   set everything up, survey the study's field in simulation, and serve the results
# make test   all tests: the quick ones, then the slow ones
# make check  format, lint, types, import contracts, docstrings, spelling
# make bench  speed and memory as ratios against a peer in the same run
# make lock   renew requirements.lock from pyproject.toml

PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
export OPENBLAS_NUM_THREADS ?= 1
SIDE_BY_SIDE := --numprocesses 2 --dist loadfile

.PHONY: help demo test check bench lock setup clean

help:
	@sed -n 's/^# //p' Makefile

setup: .venv/.ready .venv/.kernels

.venv/.ready: requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
		{ echo "spheremark needs Python 3.11; $(PYTHON) is $$($(PYTHON) --version 2>&1). Set PYTHON=/path/to/python3.11."; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv || \
		{ echo "Python could not make .venv. On Debian: apt-get install python3-venv"; rm -rf .venv; exit 1; }
	@.ci/system-packages libraries
	@echo "Installing the pinned packages into .venv (a few minutes the first time) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

# numba's cache does not see that a kernel calls another one which has changed
.venv/.kernels: .venv/.ready $(shell git ls-files 'pipelines/*.py' 'storage/*.py')
	@echo "Compiling the numerical kernels, once ..."
	@find pipelines storage -name '*.nb[ic]' -delete
	@$(BIN)/python -m spheremark.service.jobs.worker
	@touch $@

demo: setup
	@$(BIN)/spheremark demo

test: setup
	@.ci/system-packages browser
	$(BIN)/pytest $(SIDE_BY_SIDE)
	$(BIN)/pytest $(SIDE_BY_SIDE) -m slow

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	@$(BIN)/codespell $(shell git ls-files '*.py' '*.md' '*.sql' '*.html' '*.toml')

bench: setup
	@$(BIN)/spheremark bench

lock: setup
	$(BIN)/pip-compile --quiet --upgrade --extra dev --strip-extras --no-header \
		--no-emit-index-url --no-emit-find-links --no-emit-trusted-host \
		--output-file requirements.lock pyproject.toml

clean:
	rm -rf .venv build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
