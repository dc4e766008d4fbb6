# Two commands: `make train` and `make test`; both install first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CONFIG ?= quick
ARGS ?=
# Where PyTorch comes from: its own index of builds for CPUs or, where there is a GPU, pip's index. If it
# cannot be reached, that is known soon, and pip's index serves.
TORCH_INDEX ?= $(shell nvidia-smi --list-gpus >/dev/null 2>&1 || echo https://download.pytorch.org/whl/cpu)
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
TORCH = --no-deps $$(grep '^torch==' constraints.txt)
NO_TORCH = $(TORCH_INDEX) has no PyTorch for this machine, or cannot be reached: taking that of pip's index

.PHONY: install train test lint docs format bench wheel clean

install: $(VENV)/installed

# torch first, by its exact version: what depends on it then takes the build that is there.
$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "mrcdrl needs Python 3.11 or newer: make PYTHON=python3.11")'
	$(PYTHON) -m venv $(VENV)
	$(PIP) $(TORCH) $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX) --retries 0 --timeout 5 2>/dev/null) || \
	  { test -n "$(TORCH_INDEX)" && echo "$(NO_TORCH)" && $(PIP) $(TORCH); }
	$(PIP) -c constraints.txt -e '.[dev]'
	touch $@

train: install
	$(BIN)/mrcdrl train --config $(CONFIG) $(if $(ROBOTS),--robots $(ROBOTS)) $(ARGS)

# By several processes, each with a file of tests at a time; ARGS="-n 0" runs all in one.
test: install
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder $(ARGS)

lint: install
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/codespell

# The documentation as a site in build/docs; a warning fails it. The first call installs what it takes.
docs: $(VENV)/docs-installed
	$(BIN)/python -m sphinx --quiet --fail-on-warning -c docs -d build/doctrees . build/docs

$(VENV)/docs-installed: $(VENV)/installed
	$(PIP) -c constraints.txt -e '.[docs]'
	touch $@

format: install
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Measures what needs no peer, for some ten minutes, and writes the page of benchmarks to build/benchmarks.
bench: install
	$(BIN)/python -m benchmarks.summary --measure build/benchmarks

# The source archive, and the wheel built from it, in dist/: the same bytes wherever a commit is built.
wheel: export SOURCE_DATE_EPOCH ?= $(shell git log -1 --format=%ct 2>/dev/null || echo 1577836800)
wheel: install
	rm -rf dist
	$(BIN)/python -m build --no-isolation --sdist --outdir dist/raw
	mkdir dist/tree && tar --extract --gzip --file dist/raw/*.tar.gz --directory dist/tree
	name=$$(basename dist/raw/*.tar.gz .tar.gz) && tar --create --directory dist/tree --sort=name --format=gnu \
	  --mtime=@$$SOURCE_DATE_EPOCH --owner=0 --group=0 --numeric-owner --mode=u+rwX,go+rX,go-w $$name | gzip --no-name --best > dist/$$name.tar.gz
	$(BIN)/python -m build --no-isolation --wheel --outdir dist dist/tree/*
	rm -rf dist/raw dist/tree

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
