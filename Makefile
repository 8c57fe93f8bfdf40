# guide: everything is built, tested and measured from here. `make help` lists the targets.
#
#   make demo        install what is missing, build, render the ajar scene with and without guiding, compare
#   make test        install what is missing, build, run every test
#   make             build only           make bench       run the microbenchmarks
#   make bench-readme                     put the last bench's figures into the README
#   make bench-error [PRESET=quick|full]  error against run time: tables and plots in out/bench-error-PRESET
#   make bench-error PRESET=denoise       trained and then frozen fields: not denoised, after and during the training
#   make bench-denoise                     what denoising quadtrees is worth: out/bench-denoise.md
#   make study-kd [PRESET=quick|full]     signatures of guide_kd.h against sample counts: out/study-kd-PRESET
#   make study-kd-readme [PRESET=quick]   put its tables and pictures into the README
#   make stress      hostile and extreme input for every header, STRESS_SECONDS=30 STRESS_SEED=1 STRESS_ONLY=group
#                    STRESS_CASES=50: so many cases a group instead, the same on every machine
#   make build/train_histogram            data and training of the network in examples/weights (--help)
#   make format      clang-format in place  make lint        only check
#
#   config=release|debug|scalar|sanitize|tsan|coverage    each has its own folder (build/, build-debug/, ...)
#   CC=clang  V=1  WERROR=1  NO_INSTALL=1  TESTS="sdtree bsdf"  TEST_FILTER="*threads*"  TEST_JOBS=1
#   GUIDE_SCENES=folder with downloaded scenes   DEMO_SECONDS=40  DEMO_SIZE=320x180
#   OPENPGL_DIR=installation of Intel Open PGL: builds the renderer's method openpgl
#   DNNL_DIR=installation of oneDNN 2 (else the system's, if any): bench_nn compares with it

config ?= release
DEMO_SECONDS ?= 40
DEMO_SIZE ?= 320x180
STRESS_SECONDS ?= 30
STRESS_SEED ?= 1

ifeq ($(origin CC),default)
CC := $(firstword $(foreach c,gcc clang,$(if $(shell command -v $(c) 2>/dev/null),$(c))) cc)
endif
ifeq ($(origin CXX),default)
CXX := $(firstword $(foreach c,$(if $(findstring clang,$(CC)),clang++) g++ clang++,$(if $(shell command -v $(c) 2>/dev/null),$(c))) c++)
endif
AR ?= ar

# ---- configurations -------------------------------------------------------------------------------------------

release_FLAGS := -O3 -DNDEBUG
debug_FLAGS := -O0 -g
scalar_FLAGS := -O2 -g1 -DGSD_NO_SIMD -DGKD_NO_SIMD -DGNN_NO_SIMD
sanitize_FLAGS := -O1 -g1 -fno-omit-frame-pointer -fsanitize=address,undefined -fno-sanitize-recover=undefined
tsan_FLAGS := -O1 -g1 -fno-omit-frame-pointer -fsanitize=thread
coverage_FLAGS := -O0 -g --coverage
ifeq ($($(config)_FLAGS),)
$(error config=$(config) is unknown: use release, debug, scalar, sanitize, tsan or coverage)
endif
B := build$(if $(filter-out release,$(config)),-$(config))

# ---- compiler and libraries -----------------------------------------------------------------------------------

# Homebrew keeps its headers where compilers do not look.
PREFIX_INC := $(if $(wildcard /opt/homebrew/include),-I/opt/homebrew/include)
PREFIX_LIB := $(if $(wildcard /opt/homebrew/lib),-L/opt/homebrew/lib)

# Embree 4 where its header is found, else Embree 3 (examples/tracer/embree.h chooses alike). oneDNN, a peer of bench_nn
# only, where version 2 is found.
DNNL_INC := $(if $(DNNL_DIR),-isystem $(abspath $(DNNL_DIR))/include)
ifneq ($(filter-out clean format lint deps help,$(or $(MAKECMDGOALS),all)),)
FOUND := $(shell printf '\043if __has_include(<embree4/rtcore.h>)\nembree4\n\043else\nembree3\n\043endif\n\
	\043if __has_include(<oneapi/dnnl/dnnl_version.h>)\n\043include <oneapi/dnnl/dnnl_version.h>\n\
	\043if DNNL_VERSION_MAJOR == 2\nonednn\n\043endif\n\043endif\n' | $(CC) $(PREFIX_INC) $(DNNL_INC) -E -P - 2>/dev/null)
EMBREE := $(filter embree%,$(FOUND))
endif

WARN := -Wall -Wextra -Wshadow -Wstrict-prototypes $(if $(WERROR),-Werror)
# Contraction off: a*b+c is rounded the same on every machine. errno and trapping say nothing about results.
CFLAGS_ALL = -std=c11 $($(config)_FLAGS) -ffp-contract=off $(WARN) -pthread $(CFLAGS)
TRACER_FLAGS := -fno-math-errno -fno-trapping-math
CPPFLAGS_ALL = -D_POSIX_C_SOURCE=200809L -I. -Iexamples/tracer $(PREFIX_INC) $(CPPFLAGS)
LDFLAGS_ALL = $(filter -fsanitize% --coverage,$($(config)_FLAGS)) -pthread $(PREFIX_LIB) $(LDFLAGS)
LIBS := -l$(or $(EMBREE),embree3) -lOpenEXRCore -lexpat -lassimp -lz -lm -lpthread

ifneq ($(filter onednn,$(FOUND)),)
CPPFLAGS_ALL += -DBENCH_DNNL $(DNNL_INC)
PEER_LIBS = $(if $(DNNL_DIR),$(foreach d,$(wildcard $(DNNL_DIR)/lib $(DNNL_DIR)/lib64),-L$d -Wl$(comma)-rpath$(comma)$(abspath $d))) -ldnnl
endif

# Intel Open PGL is optional: one C++ file adapts it, and what is linked needs the C++ library then.
ifneq ($(OPENPGL_DIR),)
OPENPGL_PREFIX := $(abspath $(OPENPGL_DIR))
OPENPGL_LIB := $(patsubst %/,%,$(dir $(firstword $(wildcard $(foreach d,lib lib64 lib/*,$(OPENPGL_PREFIX)/$d/libopenpgl.*)))))
ifeq ($(and $(OPENPGL_LIB),$(wildcard $(OPENPGL_PREFIX)/include/openpgl/cpp/OpenPGL.h)),)
$(error OPENPGL_DIR=$(OPENPGL_DIR) has no include/openpgl/cpp/OpenPGL.h or no lib/libopenpgl)
endif
CXXFLAGS_ALL = -std=c++17 $($(config)_FLAGS) -ffp-contract=off $(filter-out -Wstrict-prototypes,$(WARN)) -pthread \
	-isystem $(OPENPGL_PREFIX)/include $(CXXFLAGS)
CPPFLAGS_ALL += -DTR_OPENPGL
LDFLAGS_ALL += -L$(OPENPGL_LIB) -Wl,-rpath,$(OPENPGL_LIB)
LIBS += -lopenpgl -ltbb -lstdc++
endif

# ---- files ----------------------------------------------------------------------------------------------------

HEADERS := $(wildcard guide_*.h)
TRACER_MAINS := render imgerr train_histogram
TRACER_SRC := $(filter-out $(TRACER_MAINS:%=examples/tracer/%.c),$(wildcard examples/tracer/*.c))
TRACER_OBJ := $(TRACER_SRC:examples/tracer/%.c=$(B)/obj/tracer/%.o) $(if $(OPENPGL_DIR),$(B)/obj/tracer/method_openpgl.o)
PROGRAMS := $(patsubst examples/tracer/%.c,$(B)/%,$(wildcard $(TRACER_MAINS:%=examples/tracer/%.c)))
EXAMPLES := $(patsubst examples/%.c,$(B)/examples/%,$(wildcard examples/*.c))
TESTS_ALL := $(patsubst tests/%.c,$(B)/tests/%,$(wildcard tests/test_*.c))
# The other tests are of the headers alone.
TRACER_TESTS := bsdf image light photon_net photon_pass render scene
MICRO := $(B)/bench_sdtree $(B)/bench_kd $(B)/bench_photon $(B)/bench_field $(B)/bench_denoise $(B)/bench_nn
BENCHES := $(patsubst bench/%.c,$(B)/%,$(wildcard bench/bench_*.c))
STRESSES := $(patsubst tests/%.c,$(B)/tests/%,$(wildcard tests/stress_*.c))
# Programs of bench/ that are not timings: `make bench` does not run them.
BENCH_MAINS := make_reference study_kd
BENCH_TOOLS := $(patsubst bench/%.c,$(B)/%,$(wildcard $(BENCH_MAINS:%=bench/%.c)))
# TESTS="a b" picks test_a and test_b, and "matrix", "uninitialised", "rig", "cli"; empty = all.
TEST_PROGRAMS := $(if $(TESTS),$(filter $(TESTS:%=$(B)/tests/test_%),$(TESTS_ALL)),$(TESTS_ALL))
SOURCES := $(sort $(HEADERS) $(wildcard examples/*.c examples/tracer/*.[ch] examples/tracer/*.cpp tests/*.[ch] tests/*/*.[ch] bench/*.[ch] bench/*.cpp))
SCRIPTS := .ci/run $(wildcard tests/*.sh examples/*.sh bench/*.sh)

.PHONY: all programs deps check-deps demo test stress run-demo run-test run-stress expected-count bench run-bench bench-readme bench-error run-bench-error bench-denoise run-bench-denoise study-kd run-study-kd study-kd-readme format lint clean help
.DELETE_ON_ERROR:
.SUFFIXES:

# Build in parallel unless the caller said how.
JOBS = $(if $(findstring j,$(filter-out --%,$(MAKEFLAGS))),,-j$(shell nproc 2>/dev/null || echo 2))
SUB = +@$(MAKE) --no-print-directory $(JOBS)

all: check-deps
	$(SUB) programs

programs: $(PROGRAMS) $(EXAMPLES) $(TESTS_ALL) $(STRESSES) $(BENCHES) $(BENCH_TOOLS)

help:
	@sed -n '2,/^$$/s/^# \{0,1\}//p' Makefile

# ---- rules ----------------------------------------------------------------------------------------------------

Q := $(if $(V),,@)
SAY = $(if $(V),@:,@printf '%-4s %s\n')

# Rewritten only when the flags change, so that a change of flags rebuilds.
BUILD_FLAGS = $(strip $(CC) $(CFLAGS_ALL) $(CPPFLAGS_ALL) $(LDFLAGS_ALL) $(LIBS) $(if $(OPENPGL_DIR),$(CXX) $(CXXFLAGS_ALL)))
$(B)/flags: FORCE
	@mkdir -p $(B)
	@printf '%s\n' '$(BUILD_FLAGS)' | cmp -s - $@ || \
		printf '%s\n' '$(BUILD_FLAGS)' > $@
.PHONY: FORCE
FORCE:

$(B)/obj/tracer/%.o: examples/tracer/%.c $(B)/flags
	$(SAY) CC $<
	$(Q)mkdir -p $(@D)
	$(Q)$(CC) $(CFLAGS_ALL) $(TRACER_FLAGS) $(CPPFLAGS_ALL) -MMD -MP -c $< -o $@

$(B)/obj/tracer/%.o: examples/tracer/%.cpp $(B)/flags
	$(SAY) CXX $<
	$(Q)mkdir -p $(@D)
	$(Q)$(CXX) $(CXXFLAGS_ALL) $(TRACER_FLAGS) $(CPPFLAGS_ALL) -MMD -MP -c $< -o $@

$(B)/obj/%.o: %.c $(B)/flags
	$(SAY) CC $<
	$(Q)mkdir -p $(@D)
	$(Q)$(CC) $(CFLAGS_ALL) $(CPPFLAGS_ALL) -MMD -MP -c $< -o $@

$(B)/obj/%.o: %.cpp $(B)/flags
	$(SAY) CXX $<
	$(Q)mkdir -p $(@D)
	$(Q)$(CXX) $(CXXFLAGS_ALL) $(CPPFLAGS_ALL) -MMD -MP -c $< -o $@

$(B)/libtracer.a: $(TRACER_OBJ)
	$(SAY) AR $@
	$(Q)rm -f $@
	$(Q)$(AR) rcs $@ $^

LINK = $(Q)mkdir -p $(@D) && $(CC) $(LDFLAGS_ALL) $(filter %.o %.a,$^)

$(PROGRAMS): $(B)/%: $(B)/obj/tracer/%.o $(B)/libtracer.a
	$(SAY) LD $@
	$(LINK) $(LIBS) -o $@

$(EXAMPLES): $(B)/examples/%: $(B)/obj/examples/%.o
	$(SAY) LD $@
	$(LINK) $(LIBS) -o $@

$(TESTS_ALL): $(B)/tests/%: $(B)/obj/tests/%.o
	$(SAY) LD $@
	$(LINK) -lcmocka $(if $(filter %.a,$^),$(LIBS),-lm -lpthread) -o $@

$(TRACER_TESTS:%=$(B)/tests/test_%): $(B)/libtracer.a

$(STRESSES): $(B)/tests/%: $(B)/obj/tests/%.o
	$(SAY) LD $@
	$(LINK) -lm -lpthread -o $@

$(B)/bench_field: $(if $(OPENPGL_DIR),$(B)/obj/bench/field_openpgl.o)

$(BENCHES) $(BENCH_TOOLS): $(B)/%: $(B)/obj/bench/%.o $(B)/libtracer.a
	$(SAY) LD $@
	$(LINK) $(LIBS) $(if $(filter %/bench_nn,$@),$(PEER_LIBS)) -o $@

.SECONDARY:
-include $(wildcard $(B)/obj/*/*.d $(B)/obj/*.d)

# ---- what the machine must have -------------------------------------------------------------------------------

# One run of the preprocessor lists the headers that are not there, by the names of Debian's packages.
define DEPS_SCRIPT
list_missing() {
    if ! command -v $(CC) >/dev/null 2>&1; then
        echo "gcc libc6-dev libembree-dev libopenexr-dev libcmocka-dev libexpat1-dev libassimp-dev libstb-dev zlib1g-dev"
        return
    fi
    printf '%s\n' \
        '#if !__has_include(<stdio.h>)' 'libc6-dev' '#endif' \
        '#if !__has_include(<embree4/rtcore.h>) && !__has_include(<embree3/rtcore.h>)' 'libembree-dev' '#endif' \
        '#if !__has_include(<OpenEXR/openexr.h>)' 'libopenexr-dev' '#endif' \
        '#if !__has_include(<cmocka.h>)' 'libcmocka-dev' '#endif' \
        '#if !__has_include(<expat.h>)' 'libexpat1-dev' '#endif' \
        '#if !__has_include(<assimp/scene.h>)' 'libassimp-dev' '#endif' \
        '#if !__has_include(<stb/stb_image.h>)' 'libstb-dev' '#endif' \
        '#if !__has_include(<zlib.h>)' 'zlib1g-dev' '#endif' |
        $(CC) $(PREFIX_INC) -E -P - | tr -s '\n' ' '
}
missing=$$(list_missing | sed 's/ *$$//')
[ -z "$$missing" ] && exit 0
if command -v apt-get >/dev/null 2>&1; then
    sudo=
    [ "$$(id -u)" = 0 ] || sudo=sudo
    command="$$sudo apt-get install -y --no-install-recommends $$missing"
    command=$${command# }
    if [ -n "$(NO_INSTALL)" ]; then
        printf 'missing: %s\ninstall with: %s\n' "$$missing" "$$command" >&2
        exit 1
    fi
    if [ -n "$$sudo" ] && ! command -v sudo >/dev/null 2>&1; then
        printf 'missing: %s\nneither root nor sudo here: as root, run: %s\n' "$$missing" "$${command#sudo }" >&2
        exit 1
    fi
    echo "installing: $$missing"
    $$sudo env DEBIAN_FRONTEND=noninteractive apt-get update -qq || exit 1
    $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $$missing >/dev/null || exit 1
    missing=$$(list_missing | sed 's/ *$$//')
    [ -z "$$missing" ] && exit 0
    echo "still missing after the installation: $$missing (OpenEXR must be 3.1 or newer)" >&2
    exit 1
fi
{
    echo "missing (by Debian's names): $$missing"
    echo "install with one of:"
    echo "  dnf install gcc make embree-devel openexr-devel libcmocka-devel expat-devel assimp-devel stb-devel zlib-devel"
    echo "  pacman -S --needed gcc make embree openexr cmocka expat assimp stb zlib"
    echo "  brew install embree openexr cmocka expat assimp zlib"
    echo '    (and for stb: git clone https://github.com/nothings/stb "$$(brew --prefix)/include/stb")'
} >&2
exit 1
endef
export DEPS_SCRIPT

deps:
	@sh -c "$$DEPS_SCRIPT"

check-deps:
	@NO_INSTALL=1 $(MAKE) --no-print-directory deps NO_INSTALL=1

# ---- test, demo, bench ----------------------------------------------------------------------------------------

test: deps
	$(SUB) run-test

# What the tests of the command line and of the rig run; the fast build has the examples too, for the optimiser's warnings.
CLI_PROGRAMS := $(if $(if $(TESTS),$(filter cli,$(TESTS)),all),$(PROGRAMS) $(B)/make_reference $(B)/bench_field)
RIG_PROGRAMS := $(if $(filter release,$(config)),$(if $(if $(TESTS),$(filter rig,$(TESTS)),all),$(PROGRAMS) $(B)/bench_error $(B)/make_reference $(B)/study_kd))
OPTIMISED := $(if $(filter release,$(config)),$(if $(TESTS),,$(EXAMPLES)))

run-test: $(TEST_PROGRAMS) $(CLI_PROGRAMS) $(RIG_PROGRAMS) $(OPTIMISED)
	@BUILD=$(B) CONFIG=$(config) CC='$(CC)' TESTS='$(TESTS)' bash tests/run.sh $(TEST_PROGRAMS)
	$(if $(filter coverage,$(config)),@$(MAKE) --no-print-directory coverage-report)

# The headers alone: needs no library.
stress:
	$(SUB) run-stress

run-stress: $(STRESSES)
	@CONFIG=$(config) SECONDS_ALL='$(STRESS_SECONDS)' CASES='$(STRESS_CASES)' SEED='$(STRESS_SEED)' ONLY='$(STRESS_ONLY)' \
		bash tests/stress.sh $(STRESSES)

# Write down how many tests there are now: `make test` fails when fewer run.
expected-count: deps
	$(SUB) programs
	@BUILD=$(B) CONFIG=$(config) CC='$(CC)' RECORD=1 bash tests/run.sh $(TESTS_ALL)

.PHONY: coverage-report
coverage-report:
	@printf 'lines run by the tests:\n'
	@cd $(B) && for f in obj/tests/*.gcda obj/tracer/*.gcda; do \
		[ -e "$$f" ] && $(if $(findstring clang,$(CC)),llvm-cov gcov,gcov) -n "$$f" 2>/dev/null; done | \
		awk "/^File/ { f = \$$2 } /^Lines executed/ && f !~ /usr.include/ { split(\$$2, a, \":\"); p = a[2]; sub(/%/, \"\", p); \
		if (p + 0 >= best[f] + 0) best[f] = p; f = \"\" } END { for (f in best) if (f) printf \"  %6.2f %%  %s\n\", best[f], f }" | sort -k3

demo: deps
	$(SUB) run-demo

run-demo: $(PROGRAMS)
	@BUILD=$(B) SECONDS_EACH=$(DEMO_SECONDS) SIZE=$(DEMO_SIZE) sh examples/demo.sh

bench: deps
	$(SUB) run-bench

run-bench: $(MICRO)
	@mkdir -p out
	@BENCH_FLAGS='$(CFLAGS_ALL)' BENCH_COMMIT="$$(git describe --always --dirty 2>/dev/null)"; \
	export BENCH_FLAGS BENCH_COMMIT; \
	for b in $(MICRO); do echo "$$b"; $$b --json out/$${b##*/}.json || exit 1; done

# Put the figures of the last `make bench` into the README.
bench-readme:
	@sh bench/readme.sh README.md $(MICRO:$(B)/%=out/%.json)

# Quick: under 10 minutes on two cores. Full: an hour and a half; with GUIDE_SCENES the downloaded scenes too, hours.
PRESET ?= quick
PRESET_quick := --scenes ajar,lamps,torus,pool,cornell --seconds 5,20
PRESET_full = --scenes $(shell cd examples/scenes 2>/dev/null && ls *.xml | sed 's/\.xml//' | \
	paste -sd, -)$(if $(GUIDE_SCENES),$(comma)veach-ajar$(comma)veach-bidir$(comma)living-room$(comma)kitchen) --seconds 10,30,60
# The protocol of Nilsson's thesis on denoising (chapter 5): 3 trainings, then 512 samples per pixel, every scene.
PRESET_denoise = $(firstword $(PRESET_full)) $(word 2,$(PRESET_full)) --size 160x90 --train 8,32,128 --spp 512 --seeds 3 \
	--methods sdtree:denoise=off,sdtree:denoise_when=last,sdtree
comma := ,

bench-error: deps
	$(SUB) run-bench-error

run-bench-error: $(B)/render $(B)/bench_error
	@$(B)/bench_error $(PRESET_$(PRESET)) --out out/bench-error-$(PRESET) $(ARGS)

# Second moments with and without denoising: some 6 minutes on two cores; see bench/denoise.sh.
bench-denoise: deps
	$(SUB) run-bench-denoise

run-bench-denoise: $(B)/render
	@mkdir -p out && RENDER=$(B)/render bench/denoise.sh >out/bench-denoise.md && cat out/bench-denoise.md

# Quick: about 10 minutes of one core. Full: half a day.
study-kd: deps
	$(SUB) run-study-kd

run-study-kd: $(B)/render $(B)/imgerr $(B)/bench_error $(B)/study_kd
	@BENCH_COMMIT="$$(git describe --always --dirty 2>/dev/null)" $(B)/study_kd --preset $(PRESET) $(ARGS)

# Put its tables and pictures into the README.
study-kd-readme:
	@sh bench/readme.sh README.md out/study-kd-$(PRESET)/study_kd.md
	@cp out/study-kd-$(PRESET)/cells-*.png examples/images/

# ---- upkeep ---------------------------------------------------------------------------------------------------

# Formatting differs between versions of clang-format: only version 14 counts.
CLANG_FORMAT ?= $(shell for c in clang-format-14 clang-format; do \
	$$c --version 2>/dev/null | grep -q 'version 14\.' && { echo $$c; break; }; done)

format:
	@[ -n "$(CLANG_FORMAT)" ] || { echo 'format: needs clang-format 14' >&2; exit 1; }
	@$(CLANG_FORMAT) -i $(SOURCES)

lint:
	@[ -n "$(CLANG_FORMAT)" ] || { echo 'lint: needs clang-format 14' >&2; exit 1; }
	@$(CLANG_FORMAT) --dry-run -Werror --ferror-limit=1 $(SOURCES)
	@for s in $(SCRIPTS); do bash -n $$s || exit 1; done
	@! grep -nE '[[:space:]]+$$' $(SOURCES) $(SCRIPTS) Makefile $(wildcard *.md examples/scenes/*.*) || \
		{ echo 'lint: white space at line ends' >&2; exit 1; }
	@echo 'lint: clean'

clean:
	rm -rf build build-debug build-scalar build-sanitize build-tsan build-coverage out
