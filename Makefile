# Every target sets up .venv first. A Python >= 3.12 is enough; `uv` is used when it is there and installed into .venv when not.
.PHONY: demo test lint type format results pictures docs system lock clean

BIN := .venv/bin
READY := .venv/ready

demo: $(READY)
	$(BIN)/lfd demo --out outputs/demo --overwrite

# The tests of a file stay together, and share what is slow to build. With more cores: make test WORKERS=8
WORKERS := 2
test: lint type
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS) --dist loadfile

lint: $(READY)
	$(BIN)/ruff format --check && $(BIN)/ruff check && $(BIN)/lint-imports

type: $(READY)
	$(BIN)/pyright

format: $(READY)
	$(BIN)/ruff format && $(BIN)/ruff check --fix

results: $(READY)
	$(BIN)/lfd demo --out outputs/demo --overwrite --results docs/results.md
	$(BIN)/lfd bench sim --full --results docs/results.md
	$(BIN)/lfd bench cameras --results docs/results.md
	$(BIN)/lfd bench record --results docs/results.md
	$(BIN)/lfd bench convert --results docs/results.md
	$(BIN)/lfd bench train --results docs/results.md
	$(BIN)/lfd bench compounding --results docs/results.md
	$(BIN)/lfd bench dagger --results docs/results.md
	$(BIN)/lfd bench comparisons --results docs/results.md
	$(BIN)/lfd bench irl --results docs/results.md
	$(BIN)/lfd bench corrections --results docs/results.md
	$(BIN)/lfd bench interaction --results docs/results.md
	$(BIN)/lfd bench replay --results docs/results.md
	$(BIN)/lfd bench console --results docs/results.md
	$(BIN)/lfd experts --episodes 50 --results docs/results.md

pictures: $(READY)
	$(BIN)/python docs/make_pictures.py
	$(BIN)/python docs/make_console_pictures.py

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# What cameras and pictures need beside Python, on Debian and Ubuntu: EGL with Mesa's CPU renderer, a software Vulkan
# driver for Rerun's viewer, and Chromium for the tests and pictures of pages.
system:
	apt-get update -qq && apt-get install -y -qq libegl1 libgl1 libgl1-mesa-dri mesa-vulkan-drivers chromium

lock: $(READY)
	$(UV) pip compile --quiet --no-emit-index-url --no-header --python-version 3.12 --extra dev pyproject.toml --output-file requirements.lock

clean:
	rm -rf .venv outputs

$(READY): pyproject.toml requirements.lock .python-version
	test -d .venv || uv venv --quiet --python 3.12 .venv 2>/dev/null || $(PYTHON) -m venv .venv
	command -v uv >/dev/null || test -x $(BIN)/uv || $(BIN)/python -m pip install --quiet uv
	VIRTUAL_ENV=.venv $(UV) pip install --quiet --no-deps -r requirements.lock
	VIRTUAL_ENV=.venv $(UV) pip install --quiet --no-deps --editable .
	touch $(READY)

# The first Python of at least 3.12; the message below is all that is run when there is none.
PYTHON = $(or $(shell for p in python3 python3.12 python3.13 python3.14; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null && echo $$p && break; done), \
	$(error lfd needs Python 3.12 or newer, or uv, which brings one: neither was found))
UV = $(shell command -v uv || echo $(BIN)/uv)
