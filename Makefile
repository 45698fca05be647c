PYTHON ?= python3
BIN := .venv/bin

.PHONY: setup demo test test-long check bench clean

setup: .venv/ready

.venv/ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "suturetrack needs Python 3.11 or newer: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	touch $@

demo: setup
	$(BIN)/suturetrack demo

test: check

check: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/pytest -m 'not long'

test-long: setup
	$(BIN)/pytest -m long -o timeout=7200 -o faulthandler_timeout=7500

bench: setup
	$(BIN)/suturetrack bench segmentation
	$(BIN)/suturetrack bench initialization --seeds 3
	$(BIN)/suturetrack bench tracking --seeds 3
	$(BIN)/suturetrack bench latency

clean:
	rm -rf .venv
