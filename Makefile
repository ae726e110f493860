# make demo | make lab | make test | make campaign | make measured | make chapters | make student | make quiz | make slides | make book | make wheel: each first sets up the virtual environment .venv, which all of them share. Only Python >= 3.11 and make are needed. What only tests and development need is installed by make dev, which make test, lint, format and campaign do first.
PYTHON ?= python3
VENV ?= .venv
# Where pip should look for PyTorch, if not at the default: see docs/install.md.
TORCH_INDEX ?=
# More options for jupyter lab, such as --allow-root or --no-browser.
LAB ?=
# Where a learner's notebooks are kept, a folder in this one.
COURSE ?= course
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
STAMP := $(VENV)/.setup-done
DEV_STAMP := $(VENV)/.dev-done

# Each process would compile all sources again; the tests start many.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup dev demo test campaign measured chapters lint format lab student quiz slides book wheel clean

setup: $(STAMP)

$(INSTALLED): pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(None if v >= (3, 11) else f"gsfusion_nb needs Python >= 3.11, found {v[0]}.{v[1]}: run  make PYTHON=/path/to/python3.11 ...")'
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "Installing what the demo and the course need into $(VENV) (about 2 minutes, 2.4 GB) ..."
	@$(BIN)/python -m pip install --quiet --no-compile "torch>=2.6,<2.14" $(if $(TORCH_INDEX),--index-url $(TORCH_INDEX))
	@$(BIN)/python -m pip install --quiet --no-compile --editable .
	@touch $(INSTALLED)

$(STAMP): $(INSTALLED)
	-@$(BIN)/gsfusion-nb doctor --warm
	@touch $(STAMP)

dev: $(STAMP) $(DEV_STAMP)

$(DEV_STAMP): $(INSTALLED)
	@echo "Installing what tests and development need into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --no-compile --editable ".[dev]"
	@touch $(DEV_STAMP)

# Compiles what it needs itself, on two cores, while it works.
demo: $(INSTALLED)
	$(BIN)/gsfusion-nb demo

test: dev
	$(BIN)/python -m pytest -n auto --dist worksteal

# Runs that are killed and resumed, damaged files, every test marked slow, a class in nbgrader, and changes of the
# program that some test must notice: see docs/trust.md. About four hours. MUTANTS: how many changes of each room,
# MINUTES: when to stop beginning others.
MUTANTS ?= 40
MINUTES ?= 120
campaign: dev
	$(BIN)/python tests/campaign/kills.py --kills 300
	$(BIN)/python tests/campaign/interrupts.py --tries 60
	$(BIN)/python tests/campaign/fuzz.py --inputs 20000
	$(BIN)/python -m pytest -n auto --dist worksteal -m slow --ignore=tests/browser
	$(BIN)/python -m pytest -m slow tests/browser
	$(BIN)/python -m pip install --quiet "nbgrader>=0.9.5"
	$(BIN)/python -m pytest -m ci tests/course/test_nbgrader.py
	GSNB_CAMPAIGN=1 $(BIN)/python -m pytest -m ci tests/browser/test_learners_path.py
	$(BIN)/python -m pip install --quiet "cosmic-ray>=8.4" "coverage>=7.6"
	$(BIN)/python -m pytest tests/campaign/test_mutants.py
	$(BIN)/python tests/campaign/mutants.py --sample $(MUTANTS) --minutes $(MINUTES)

# The tables in docs/ whose numbers are older than the code that they depend on, and the commands that measure them again.
# make measured CONFIRM=1 asks whether today's maps are those of the old tables, bit for bit: then they are not old.
# make measured RENEW="tracking-accuracy ..." RECORDINGS=PATH/TO runs these commands in the folder of the recordings and
# fills the pages: docs/measured/index.md.
CONFIRM ?=
RENEW ?=
RECORDINGS ?= .
measured: dev
	$(BIN)/python tools/measured.py $(if $(CONFIRM),--confirm) $(if $(RENEW),--renew $(RENEW) --recordings "$(RECORDINGS)")

# The stored chapters, executed again in place: all of them, or make chapters CHAPTERS="09 12". Kernels are compiled
# before, and chapter 10, which measures times, comes last. What the chapters write in notebooks/runs is removed.
CHAPTERS ?= $(sort $(basename $(notdir $(wildcard notebooks/*.ipynb))))
chapters: dev
	$(BIN)/gsfusion-nb doctor --warm
	@set -e; course=$$(mktemp -d); trap 'rm -rf "$$course" notebooks/runs' EXIT; \
	for chapter in $(filter-out 10%,$(CHAPTERS)) $(filter 10%,$(CHAPTERS)); do \
	  rm -rf "$$course"/* notebooks/runs; \
	  GSNB_VIEW=static GSNB_COURSE_FILE="$$course/course.json" $(BIN)/jupyter nbconvert --to notebook --execute --inplace \
	    --ExecutePreprocessor.store_widget_state=False --ExecutePreprocessor.record_timing=False \
	    --ExecutePreprocessor.timeout=900 notebooks/$$chapter*.ipynb; \
	done
	$(BIN)/python tools/claims.py notebooks/*.ipynb

lint: $(DEV_STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright

format: $(DEV_STAMP)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# The learner's copies, without solutions, in a folder of the project where changes are kept. Links to source files
# need the project as the root of the server.
lab: setup
	@$(BIN)/gsfusion-nb course $(COURSE)
	$(BIN)/jupyter lab --ServerApp.root_dir="$(CURDIR)" --LabApp.default_url=/lab/tree/$(COURSE)/00_quickstart.ipynb $(LAB)

# Copies of the notebooks to hand out, without solutions and outputs.
student: setup
	$(BIN)/gsfusion-nb course runs/student --for-class

# The bank of questions, for lecturers: docs/teaching/quiz.md.
quiz: setup
	$(BIN)/python tools/quiz.py runs/quiz

# The decks of slides as HTML, in runs/slides; needs Node: docs/teaching/slides.md.
slides: setup
	$(BIN)/python tools/slides.py docs/teaching/slides notebooks runs/slides

# The notebooks and the documentation as a web site in runs/book: docs/book.md. Needs the network only when the extra
# "book" is not installed yet. REPOSITORY=https://github.com/OWNER/NAME adds links to source files, ADDRESS=https://SITE the
# picture that other sites show beside a link to it.
REPOSITORY ?=
book: setup
	@PYTHONPATH=tools $(BIN)/python -m book --installed || $(BIN)/python -m pip install --quiet --editable ".[book]"
	PYTHONPATH=tools $(BIN)/python -m book runs/book $(if $(REPOSITORY),--repository "$(REPOSITORY)") $(if $(ADDRESS),--address "$(ADDRESS)")

# A wheel in dist/, which needs neither this folder nor a compiler: pip install dist/gsfusion_nb-*.whl
wheel:
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@rm -rf build # setuptools would put files of earlier builds into the wheel
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .
	@ls -l dist/*.whl

clean:
	rm -rf $(VENV) build dist *.egg-info
