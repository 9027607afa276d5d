# Two commands matter: `make demo` and `make test`; `make test-all` runs the slow tests and builds the documentation as well. Each sets up what it needs in .venv.
# While you work, `make quick DIR=relative/limb` checks the changed files and runs those tests of one folder of tests/ that took at most 0.1 s when they last ran.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Modules that no file keeps compiled cost each process of the tests twice the time of its imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo quick test test-all lowest check docs notebooks wheel clean
demo: $(VENV)/installed
	$(BIN)/giantlike demo --output demo-output

quick: $(VENV)/installed-dev
	@test -n "$(DIR)" || { echo "which folder of tests/? make quick DIR=relative/limb"; exit 2; }
	git diff --name-only --diff-filter=d HEAD -- '*.py' | xargs $(BIN)/ruff check --force-exclude
	git diff --name-only --diff-filter=d HEAD -- '*.py' | xargs $(BIN)/ruff format --check --force-exclude
	$(BIN)/pytest -q -m "not slow" --longest 0.1 -n 2 --dist worksteal tests/$(DIR)

test: check
	$(BIN)/pytest -m "not slow" -n 2 --dist worksteal
	$(BIN)/pytest -q --doctest-modules giantlike

test-all: test docs
	$(BIN)/pytest -m slow -n 2 --dist worksteal

# The demonstration with the lowest versions of all dependencies that pyproject.toml allows.
lowest:
	$(PYTHON) -m venv $(VENV)-lowest
	$(VENV)-lowest/bin/pip install -q --disable-pip-version-check 'uv>=0.5'
	$(VENV)-lowest/bin/uv pip install -q --python $(VENV)-lowest/bin/python --resolution lowest-direct .
	$(VENV)-lowest/bin/giantlike demo --output $(VENV)-lowest/demo-output

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
	rm -rf $(VENV) $(VENV)-lowest build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis demo-output docs/_build docs/api docs/gallery docs/plots
	find . -name '*.nb[ic]' -path '*/__pycache__/*' -delete
