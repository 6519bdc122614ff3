# Everything is set up in .venv; 'make demo' and 'make test' set it up themselves.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/ready
DOCS_READY := .venv/docs-ready
# A photo inside the scikit-image wheel, so that none has to be downloaded.
PHOTO := .venv/lib/python3*/site-packages/skimage/data/coffee.png

# Sets of images to measure on, see 'eigengs-dr bench tables --help'; without them less is measured.
DATA ?= data
RESULTS := build/report

# Tests run in as many processes as there are cores, which take over each other's; a process takes about 1 GB.
ON_ALL_CORES := -n logical --maxprocesses 4 --dist worksteal

# Path of a simulator of the CUDA driver: a program that runs the command it is given.
CUDASIM ?= $(wildcard ../shared/cudasim/cudasim)

LLVM_ADVICE := install LLVM 18 or newer and libatomic (as root: Debian, Ubuntu 'apt install \
libllvm19 libatomic1', Fedora 'dnf install llvm-libs libatomic', macOS 'brew install llvm'), \
then make again
VENV_ADVICE := as root, type 'apt install python3-venv', then make again

# Shell function: apt_install PACKAGES ADVICE installs where that is allowed, else says what to do.
APT_INSTALL := apt_install() { \
	if [ "$$(id -u)" = 0 ]; then as_root=env; else as_root='sudo -n'; fi; \
	echo "make setup: installing $$1"; \
	get="$$as_root apt-get -qq -y -o DPkg::Lock::Timeout=120"; \
	{ $$get install $$1 || { $$get update && $$get install $$1; }; } </dev/null >/dev/null 2>&1 \
	|| { echo "make setup: $$2" >&2; exit 1; }; }

# Set-up compiles nothing, so Python keeps the byte code of what it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup demo scenes test layers test-slow test-cuda-sim docs pages dist bench report basis clean

help:
	@echo "make demo       fit a photo; shows PSNR, time and the pictures it wrote"
	@echo "make scenes     render the Mitsuba scenes in scenes/, in 2 minutes"
	@echo "make test       linters, type checker, layers, tests"
	@echo "make test-slow  the tests that take minutes"
	@echo "make test-cuda-sim  the cuda tests without a GPU, under the simulated driver CUDASIM=PATH"
	@echo "make docs       build the manual, build/docs/html/index.html; every warning is an error"
	@echo "make pages      write measured tables, charts and figures into README.md and docs/"
	@echo "make dist       the wheel and the source distribution, in dist/, checked"
	@echo "make bench      time the renderer"
	@echo "make report     measure a part of everything into build/report, in half an hour; resumes after a break"
	@echo "make basis      train the basis that ships, again"
	@echo "make setup      only set up .venv, and libLLVM where none works"
	@echo "make clean      remove what these made"

setup: $(READY)

# pip prints hundreds of lines; the log has them, and its end is shown where pip fails. Python
# compiles what it imports, which is a small part of what pip would compile.
$(READY): pyproject.toml benchmarks/pyproject.toml
	@$(APT_INSTALL); $(PYTHON) -c 'import ensurepip' 2>/dev/null \
		|| apt_install python3-venv "$(VENV_ADVICE)"
	@$(PYTHON) -m venv .venv
	@echo "make setup: installing into .venv, in about a minute"
	@$(BIN)/python -m pip install --disable-pip-version-check --no-compile --editable '.[dev]' \
		--editable ./benchmarks >.venv/setup.log 2>&1 \
		|| { tail -n 20 .venv/setup.log >&2; \
			echo "make setup: pip failed; .venv/setup.log has all that it said" >&2; exit 1; }
	@$(APT_INSTALL); $(BIN)/eigengs-dr doctor --no-compile >/dev/null \
		|| apt_install "libllvm19 libatomic1" "$(LLVM_ADVICE)"
	@echo "make setup: compiling the programs of a first fit, in some seconds"
	@$(BIN)/eigengs-dr doctor >>.venv/setup.log || { $(BIN)/eigengs-dr doctor; exit 1; }
	@touch $@

demo: $(READY)
	@mkdir -p build/demo && rm -f build/demo/*
	@echo "A photo as 5,000 Gaussians, in 1,000 steps:"
	@$(BIN)/eigengs-dr fit $(PHOTO) -o build/demo/coffee.npz \
		--preview build/demo/coffee.png --report build/demo/coffee.json
	@echo "The same photo from the basis that ships, without a step. A basis pays for many images"
	@echo "on one set of shapes, or for a scene that has few unknowns; never for a photo at hand:"
	@$(BIN)/eigengs-dr fit $(PHOTO) --basis natural --iterations 0 \
		-o build/demo/instant.npz --preview build/demo/instant.png

scenes: $(READY)
	$(BIN)/python scenes/assets.py
	$(BIN)/eigengs-dr scene scenes/*.xml -o build/scenes

test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	@$(MAKE) --no-print-directory layers
	$(BIN)/python -m pytest -q $(ON_ALL_CORES)

layers: $(READY)
	$(BIN)/lint-imports

test-slow: $(READY)
	$(BIN)/python -m pytest -q -m slow $(ON_ALL_CORES)

# CUDASIM_APPROX: the simulated driver rounds approximate instructions as coarsely as a GPU may.
# It compiles every program with gcc at its first use, within the time of the test.
ifeq ($(wildcard $(CUDASIM)),)
test-cuda-sim:
	@echo "make test-cuda-sim: skipped, no simulator of the CUDA driver; give its path by CUDASIM="
else
test-cuda-sim: $(READY)
	CUDASIM_APPROX=1 CUDASIM_PYTHON=$(CURDIR)/$(BIN)/python \
		$(CUDASIM) $(BIN)/python -m pytest -q -rs --timeout 3000 $(ON_ALL_CORES) \
		-m 'gpu and not texture_units and not slow and not large'
endif

$(DOCS_READY): $(READY)
	$(BIN)/python -m pip install --editable '.[docs]'
	@touch $@

docs: $(DOCS_READY)
	rm -rf docs/reference/generated
	$(BIN)/sphinx-build -E -W --keep-going -n -d build/docs/doctrees docs build/docs/html

pages: $(READY)
	$(BIN)/eigengs-dr bench pages
	$(BIN)/python tools/manual/pages.py

# The wheel is built from the source distribution, so that this is known to be whole.
dist: $(READY)
	@rm -rf dist
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*

bench: $(READY)
	$(BIN)/eigengs-dr bench kernels

# To measure more, run these commands with more images, sets or steps, and 'bench number', 'bench rate'
# and 'bench scaling'.
report: $(READY)
	@mkdir -p $(RESULTS)
	$(BIN)/eigengs-dr bench stability -o $(RESULTS)
	$(BIN)/eigengs-dr bench pareto $(wildcard $(DATA)) -o $(RESULTS) --set samples --images 2
	$(BIN)/eigengs-dr bench pictures $(wildcard $(DATA)) -o $(RESULTS) --images 2
	$(if $(wildcard $(DATA)),$(BIN)/eigengs-dr bench tables $(DATA) -o $(RESULTS) --images 4 \
		--set faces256 --set cats256 --set cars256 --set natural256)

basis: $(READY)
	$(BIN)/python tools/train_natural.py eigengs_dr/eigenbasis/data/natural.npz

clean:
	rm -rf .venv build dist *.egg-info benchmarks/*.egg-info docs/tutorials/*.* docs/tutorials/images docs/reference/generated .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
