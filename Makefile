# make train: environment, installation and the main job on the small default scene.
# make test:  installation and the checks that CI makes; WORKERS processes share the tests.
# make mutants: changes of the source that no test notices; ARGS="dpl/training/metrics.py --sample 60".
# make matrix: the tests under other processor features and thread numbers; see tests/matrix.py.
# make docs:  the documentation into site/; NOTEBOOKS=false leaves them unexecuted.
PYTHON ?= python3
BIN := .venv/bin
WORKERS ?= 2

.PHONY: setup train test lint slow matrix mutants docs wheel clean

setup: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

train: setup
	$(BIN)/python scripts/train.py $(ARGS)

test: lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m 'not slow and not gpu'

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

slow: setup
	$(BIN)/python -m pytest -m 'slow and not gpu' --timeout 1800

matrix: setup
	$(BIN)/python tests/matrix.py $(ARGS)

mutants: setup
	$(BIN)/pip install --quiet -c constraints.txt -e '.[mutation]'
	$(BIN)/python tests/mutants.py $(ARGS)

docs: setup
	NO_MKDOCS_2_WARNING=1 NOTEBOOKS=$(or $(NOTEBOOKS),true) $(BIN)/python -m mkdocs build --strict -f docs/make/mkdocs.yml

wheel: setup
	$(BIN)/pip wheel --quiet --no-deps -w dist .

clean:
	rm -rf .venv build dist site
