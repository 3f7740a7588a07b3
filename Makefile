# make train: environment, installation and the main job: two models of the paper's beam, compared.
# make demo:  a model of a hollow silicone finger, fitted to 128 loads, and its page for the browser.
# make test:  installation and the checks that CI makes; WORKERS processes share the tests.
# make slow: the tests that take minutes.
# make gpu: the tests that need a GPU (with DDP on all visible ones), then speed and memory of each
#   network into benchmarks/results/devices_cuda.csv; ARGS="networks=[fcnn,pod]".
# make mutants: changes of the source that no test notices; ARGS="dpl/training/metrics.py --sample 60".
# make paper: trains all runs of the paper's tables, hours on two cores; again: continues. Then tables
#   and figures in benchmarks/results. ARGS="only_plan=true", "scale=small" (minutes), "groups=[full]".
# make matrix: the tests under other processor features and thread numbers; see tests/matrix.py.
# make tables: the numbers of benchmarks/results/ into the tables of docs/.
# make docs:  the documentation into site/.
# make pictures: executes gallery and notebooks and stores their pictures, and the one that moves.
PYTHON ?= python3
BIN := .venv/bin
WORKERS ?= 2
PIP := $(BIN)/pip install --quiet --no-compile -c constraints.txt  # Python compiles what it imports

# imports of torch take several times as long where their bytecode is not kept
unexport PYTHONDONTWRITEBYTECODE

FIRST := runs/first_$(shell date +%Y-%m-%d_%H-%M)
DEMO := $(BIN)/python scripts/train.py mesh=finger mesh.size=[0.08,0.02,0.02] mesh.cells=[24,8,8] young=1e6 \
  material.poisson=0.4 loads.deflection=0.2 data.train=128 data.val=16 data.test=8 model.rank=80 model.cells=120 \
  run=runs/demo

.PHONY: setup train demo paper test lint slow gpu matrix mutants tables docs pictures wheel clean

setup: .venv/installed

.venv/installed: .venv/run
	$(PIP) -e '.[dev]'
	touch $@

.venv/run: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(PIP) -e '.[viewer]'
	touch $@

train: .venv/run
	$(BIN)/python scripts/train.py run=$(FIRST)/unrolled $(ARGS)
	$(BIN)/python scripts/train.py model=fcnn loss=lr_star run=$(FIRST)/fcnn $(ARGS)
	$(BIN)/python scripts/compare.py run=$(FIRST)

demo: .venv/run
	if [ -f runs/demo/evaluation.json ]; then $(BIN)/python scripts/view.py run=runs/demo; \
	  else rm -rf runs/demo; $(DEMO) extras.view=true; fi

runs/demo/evaluation.json: | .venv/run
	rm -rf runs/demo
	$(DEMO)

paper: .venv/run
	$(BIN)/python scripts/paper.py $(ARGS)

test: lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal -m 'not slow and not gpu'

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

slow: setup
	$(BIN)/python -m pytest -m 'slow and not gpu' --timeout 1800

gpu: setup
	$(BIN)/python -m pytest -m gpu -rs --timeout 1800
	$(BIN)/python scripts/devices.py device=cuda folder=benchmarks/results $(ARGS)

matrix: setup
	$(BIN)/python tests/matrix.py $(ARGS)

mutants: setup
	$(PIP) -e '.[mutation]'
	$(BIN)/python tests/mutants.py $(ARGS)

tables:
	$(PYTHON) docs/make/tables.py

docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict -f docs/make/mkdocs.yml

pictures: runs/demo/evaluation.json
	$(PIP) -e '.[pictures]'
	$(BIN)/python docs/make/gallery.py
	$(BIN)/python docs/make/executed.py
	$(BIN)/python scripts/view.py run=runs/demo animation=docs/start.gif

wheel: setup
	$(BIN)/pip wheel --quiet --no-deps -w dist .

clean:
	rm -rf .venv build dist site
