# The project's habits. `make help` lists them.
PYTHON  ?= $(shell command -v python3.11 || command -v python3)
VENV    := .venv
BIN     := $(VENV)/bin
STAMP   := $(VENV)/.installed
DEMO    := demo-output
# The LLVM that Mitsuba needs, X11/GL that Blender links, and a browser for the report's screenshot test.
APT     := libx11-6 libxrender1 libxfixes3 libxi6 libxkbcommon0 libsm6 libgl1 libatomic1 libllvm19 libegl1 libgl1-mesa-dri
APT_DEV := chromium
PYTEST  := $(BIN)/pytest -q -n 2 --dist loadfile --no-loadscope-reorder

# Pages with tables made from docs/results.
RESULTS := $(addprefix docs/,ablation.md bench-select.md cost.md development.md frames.md noise.md scaling.md shots.md)

.DEFAULT_GOAL := help
.PHONY: help setup system browser demo test lint types imports docs docs-check audit robustness bench bench-shots bench-effects bench-frames pretrain fidelity scenes clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-12s %s\n", $$1, $$2}'

setup: system $(STAMP)  ## .venv with everything, system libraries where this is Debian and we are root
	@$(BIN)/dnrpipe weights >/dev/null || echo "no perceptual weights: training will say so and drop that loss"

system:
	@sh tools/system-libraries.sh $(APT)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[render,train,serve,export,ray,dev]'
	@touch $@

demo: setup  ## the demo scene from .blend to report, untrained and trained; prints the report's path
	@$(BIN)/dnrpipe prepare blender_scenes/demo.blend -w $(DEMO)/demo.dnr
	@$(BIN)/dnrpipe render -w $(DEMO)/demo.dnr --orbit 60 --untrained
	@$(BIN)/dnrpipe run blender_scenes/demo.blend --budget 25 -w $(DEMO)/demo.dnr
	@$(BIN)/dnrpipe render -w $(DEMO)/demo.dnr --orbit 60
	@$(BIN)/dnrpipe report -w $(DEMO)/demo.dnr

test: setup browser  ## lint, types, import rules, documentation, the quick tests
	@$(MAKE) --no-print-directory -j 2 lint types imports docs-check
	$(PYTEST) -m "not robustness" --durations 40

browser:
	@sh tools/system-libraries.sh $(APT_DEV)
	@sh tools/unpacked-nginx.sh .cache/nginx

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/pyright --level error

imports: $(STAMP)
	$(BIN)/lint-imports

docs: $(STAMP)  ## regenerate the CLI reference from --help, the ablation's tables from its results
	$(BIN)/python tools/cli_reference.py docs/cli.md
	$(BIN)/python -m tools.result_tables $(RESULTS)

docs-check: $(STAMP)
	$(BIN)/python tools/cli_reference.py --check docs/cli.md
	$(BIN)/python -m tools.result_tables --check $(RESULTS)
	$(BIN)/python -m tools.robustness_table --check docs/robustness.md
	$(BIN)/python -m tools.dependencies --check

audit:  ## known vulnerabilities of the pinned dependencies, by pip-audit; needs pypi.org
	$(PYTHON) -m venv .cache/audit
	.cache/audit/bin/pip install --quiet --disable-pip-version-check pip-audit
	.cache/audit/bin/pip-audit -r constraints.txt --no-deps --disable-pip --strict

robustness: setup  ## the slow tests, every case of docs/robustness.md, 2,000 damaged files of each format, 50 kills; an hour or more
	$(BIN)/python -m tools.robustness_table --check docs/robustness.md
	$(PYTEST) -m robustness
	$(PYTEST) -m "not robustness" $$($(BIN)/python -m tools.robustness_table --tests docs/robustness.md)
	$(BIN)/python -m tools.faults.fuzz --count 2000
	$(BIN)/python -m tools.faults.inject --kills 50
	$(BIN)/python -m tools.faults.memory

bench-shots: setup  ## shots of the benchmark scenes beside path tracing with a denoiser; resumable
	$(BIN)/python -m tools.bench_shots .cache/shots
	$(BIN)/python -m tools.result_tables docs/shots.md

bench-effects: setup  ## the effect plan against "everything on", on the benchmark scenes
	$(BIN)/python tools/bench_effects.py

bench: setup  ## time the parts that the README speaks of
	$(BIN)/python tools/bench.py

FRAMES := $(DEMO)/demo.dnr
bench-frames: setup  ## our frames against path tracing + denoiser at equal time; FRAMES=... names workspaces
	$(BIN)/python -m tools.bench_frames $(FRAMES)

PRETRAIN := .cache/pretrain
pretrain: setup  ## the shipped corrector: data and training, about an hour in all on two cores; goes on where it stopped
	$(BIN)/python -m tools.pretrain.data $(PRETRAIN)/data --scenes 72
	$(BIN)/python -m tools.pretrain.train $(PRETRAIN)/data $(PRETRAIN)/run --minutes 28 --ship

fidelity: setup  ## Cycles against our conversion, one feature a scene: docs/fidelity.md
	$(BIN)/python -m tools.fidelity --docs docs --jobs $$(nproc)

scenes: setup  ## the example scenes by Cycles and by us, side by side: docs/scenes.md
	$(BIN)/python -m tools.fidelity.gallery

clean:  ## remove what make made
	rm -rf $(VENV) $(DEMO) .pytest_cache .ruff_cache .hypothesis .cache
