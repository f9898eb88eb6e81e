# `make demo` and `make test` are all a newcomer needs: each builds .venv once, then works.
PYTHON ?= python3
BIN := .venv/bin
export MPLBACKEND := Agg
# Blocks of a few hundred readings are too small for BLAS threads.
export OPENBLAS_NUM_THREADS ?= 1

# Tests start many processes: these share bytecode, whatever the environment says.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test study benchmark docs reference docs-serve magyc lock clean

demo: .venv/runtime.stamp
	$(BIN)/l2m demo --out demo_out

test: .venv/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	# In the order of folders: files of whole commands are long and come first, those of units last.
	$(BIN)/pytest -n auto --dist loadfile --no-loadscope-reorder

study: .venv/dev.stamp
	$(BIN)/pytest -m study

benchmark: .venv/dev.stamp
	$(BIN)/python scripts/benchmark.py

# The site, to be opened as site/index.html; `make docs-serve` shows it while pages are written.
docs: .venv/dev.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# The pages of all options, which are part of the repository.
reference: .venv/runtime.stamp
	$(BIN)/python scripts/write_reference.py

docs-serve: .venv/dev.stamp
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve

# A peer of the studies, in an environment of its own: its needs contradict ours.
magyc: .venv-magyc/stamp

.venv-magyc/stamp: requirements-magyc.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)) and "magyc needs Python 3.11 or 3.12: make PYTHON=python3.12 magyc")'
	$(PYTHON) -m venv .venv-magyc
	.venv-magyc/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-magyc.txt
	touch $@

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11 ...")'
	$(PYTHON) -m venv .venv

.venv/runtime.stamp: .venv/bin/python requirements.lock pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --editable .
	touch $@

.venv/dev.stamp: .venv/runtime.stamp requirements-dev.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.lock
	touch $@

# Rewrites the lock files from pyproject.toml; needs pip-tools on the PATH.
lock:
	pip-compile --quiet --strip-extras --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header --output-file requirements.lock pyproject.toml
	pip-compile --quiet --strip-extras --no-emit-index-url --no-emit-find-links --no-emit-trusted-host --no-header --extra dev --extra cluster --extra studies --extra fleet --extra viewer --extra lidar --extra docs --constraint requirements.lock --output-file requirements-dev.lock pyproject.toml

clean:
	rm -rf .venv .venv-magyc demo_out site
