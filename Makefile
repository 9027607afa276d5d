# Two commands matter: `make demo` and `make test`; `make test-all` runs the slow tests and builds the documentation as well. Each sets up what it needs in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test test-all check docs notebooks wheel clean
demo: $(VENV)/installed
	$(BIN)/giantlike demo --output demo-output

test: check
	$(BIN)/pytest -m "not slow" -n 2 --dist worksteal
	$(BIN)/pytest -q --doctest-modules giantlike

test-all: test docs
	$(BIN)/pytest -m slow -n 2 --dist worksteal

check: $(VENV)/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/ruff format --check --line-length 79 $$(git ls-files README.md 'docs/*.md' 'giantlike/campaign/pages/*.md')
	$(BIN)/mypy giantlike tests
	$(BIN)/lint-imports
	$(BIN)/pytest -q tests/documentation/test_words.py

docs: $(VENV)/installed-dev
	$(BIN)/sphinx-build -q -a -W --keep-going -c docs . docs/_build/html
	@echo docs/_build/html/index.html

notebooks: $(VENV)/installed-dev
	$(BIN)/python docs/store_notebooks.py

wheel: $(VENV)/installed-dev
	$(BIN)/python -m build

$(VENV)/bin/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml | $(VENV)/bin/python
	$(BIN)/pip install -q --disable-pip-version-check -e .
	touch $@

$(VENV)/installed-dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/pip install -q --disable-pip-version-check -e '.[dev]'
	touch $@ $(VENV)/installed

clean:
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis demo-output docs/_build docs/api docs/gallery docs/plots
	find . -name '*.nb[ic]' -path '*/__pycache__/*' -delete
