# make demo   set everything up, survey the study's field in simulation, and serve the results
# make test   all tests but those of minutes, the longest first
# make test-long  those: statistics of many whole scans, and a service that is killed again and again
# make check  format, lint, types, import contracts, spelling, lock files
# make bench  speed and memory as ratios against a peer in the same run
# make reference  renew REFERENCE.md from the commands and the settings
# make docs   build the guide with pictures and a search; without, /guide shows its text
# make lock   renew the lock files from pyproject.toml
# make sbom   write the software bill of materials (CycloneDX) to build/sbom.json
# make clean  remove what the other targets made
# With PYTHON=python3.13 VENV=.venv-3.13 they use another Python and keep its packages apart.

VENV ?= .venv
PYTHON ?= $(shell for v in 3.11 3.12 3.13 3.14; do command -v python$$v && exit; done; command -v python3)
BIN := $(VENV)/bin
KERNELS := $(shell git ls-files 'pipelines/*.py' 'storage/*.py' 2>/dev/null)
export OPENBLAS_NUM_THREADS ?= 1
SIDE_BY_SIDE := --numprocesses 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

.PHONY: help setup setup-dev demo test test-long check check-text check-types check-locks bench docs reference lock sbom clean

help:
	@sed -n 's/^# //p' Makefile

setup: $(VENV)/.ready $(VENV)/.kernels

setup-dev: setup $(VENV)/.dev

$(VENV)/.ready: requirements.lock pyproject.toml .ci/install
	@.ci/system-packages libraries
	@echo "Installing the locked packages into $(VENV) ..."
	@.ci/install "$(PYTHON)" $(VENV) requirements.lock --checkout
	@touch $@

$(VENV)/.dev: $(VENV)/.ready requirements-dev.lock
	@echo "Installing what the checks and tests need into $(VENV) ..."
	@.ci/install "$(PYTHON)" $(VENV) requirements-dev.lock
	@touch $@

# numba's cache does not see that a kernel calls another one which has changed
$(VENV)/.kernels: $(VENV)/.ready $(KERNELS)
	@echo "Compiling the numerical kernels, once (a minute or two) ..."
	@find pipelines storage -name '*.nb[ic]' -delete
	@$(BIN)/python -m compileall -q __init__.py pipelines service storage web
	@$(BIN)/python -m spheremark.service.jobs.worker
	@touch $@

demo: setup
	@$(BIN)/spheremark demo

# glibc keeps freed memory, as in the workers of the service: a tenth of the tests' time
test test-long: export MALLOC_MMAP_MAX_ = 0
test test-long: export MALLOC_TRIM_THRESHOLD_ = 536870912
test: WANTED = not long and not benchmark
test-long: WANTED = long
test test-long: setup-dev
	@.ci/system-packages browser
	$(BIN)/pytest $(SIDE_BY_SIDE) -m "$(WANTED)"

check: check-text check-types check-locks

check-text: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	@$(BIN)/codespell $(shell git ls-files '*.py' '*.md' '*.sql' '*.html' '*.toml')

check-types: $(VENV)/.dev
	$(BIN)/mypy

check-locks: $(VENV)/.dev
	.ci/locks $(VENV)

bench: setup-dev
	@$(BIN)/spheremark bench

reference: setup
	@$(BIN)/python -m spheremark.service.cli.reference > REFERENCE.md

docs: setup-dev
	@$(BIN)/python -m tests.pictures web/guide/made/pictures
	@$(BIN)/sphinx-build -q -W -d build/doctrees -b html web/guide web/guide/site
	@echo "The guide is in web/guide/site; the service shows it at /guide."

lock: setup-dev
	.ci/locks $(VENV) --renew

sbom: setup-dev
	@mkdir -p build
	@$(BIN)/python -W ignore -m cyclonedx_py requirements --pyproject pyproject.toml \
		--output-reproducible -o build/sbom.json requirements.lock

clean:
	rm -rf .venv .venv-* build dist web/guide/made web/guide/site *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis \
		.import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
