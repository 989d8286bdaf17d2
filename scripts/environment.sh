#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Print the path of a Python that can run this checkout, after making its environment and compiling
# the core if need be.
#
#   sh scripts/environment.sh [--print-plan] [EXTRA ...]    EXTRA of setup.py, such as: test
#
# Where a ROS 2 is sourced, its own rclpy is used (.venv-ros sees the system's packages and
# PYTHONPATH); elsewhere community wheels are installed, those of Jazzy (.venv), or with
# ROS_WHEELS=kilted those of Kilted (.venv-kilted). Never both: two builds of one library in one
# process crash.
#
# Only the dependencies are installed, not the package: an editable install leaves egg-info in
# the tree and stale copies of the data files in the venv. A .pth file names the checkout instead,
# and the core is compiled in place.
set -eu
cd "$(dirname "$0")/.."
root=$(pwd)
python=${PYTHON:-python3}
other='name another, as in: make demo PYTHON=python3.12'

say() { printf '%s\n' "$*" >&2; }
fail() { say "error: $*"; exit 1; }

command -v "$python" >/dev/null || fail "no $python here: install Python 3.10 or later, or $other"
answers=$("$python" -c '
import sys, sysconfig
print(sysconfig.get_path("include"), sysconfig.get_config_var("CC"), sep="\n")
print(sys.base_prefix, sys.version)
sys.exit(sys.version_info < (3, 10))') ||
    fail "Python 3.10 or later is needed, $python is $("$python" -V 2>&1): $other"
{ read -r headers; read -r own_compiler; read -r interpreter; } <<END
$answers
END
compiler=
for name in "${CC:-$own_compiler}" gcc clang; do
    command -v "${name%% *}" >/dev/null && compiler=$name && break
done

if [ -n "${ROS_DISTRO:-}" ] && "$python" -c 'import rclpy' 2>/dev/null; then
    venv=.venv-ros options=--system-site-packages wheels=no distribution=$ROS_DISTRO
    cost='up to a minute and 500 MB'
    case $ROS_DISTRO in
        jazzy | kilted) ;;
        *) say "warning: only ROS 2 Jazzy and Kilted are tested, sourced is $ROS_DISTRO" ;;
    esac
elif [ -n "${ROS_DISTRO:-}" ] && [ -n "${AMENT_PREFIX_PATH:-}" ]; then
    fail "ROS 2 $ROS_DISTRO is sourced but $python ($("$python" -V)) cannot import rclpy:" \
        "use the Python ROS was built for (make demo PYTHON=/usr/bin/python3)" \
        "or a shell without ROS"
else
    venv=.venv options='' wheels=${ROS_WHEELS:-jazzy} distribution=''
    [ "$wheels" = jazzy ] || venv=.venv-$wheels
    cost='about a minute and 750 MB'
fi
if [ "${1:-}" = --print-plan ]; then
    printf 'venv: %s\nwheels: %s\ncompiler: %s\n' "$venv" "$wheels" "${compiler:-ziglang}"
    exit
fi

bin=$root/$venv/bin
# What an environment was made from; when this changes, it is made anew.
origin="$root $interpreter $distribution $(cksum <setup.py)"

# What the core in this checkout was compiled from, and what came of it: compiled when this changes.
compiled() {
    { echo "$interpreter ${FHAOSMO_DEBUG:-} ${CFLAGS:-}"
      find fhaosmo_ros studies -name '*.pyx' -o -name '*.pxd' | LC_ALL=C sort | xargs cksum setup.py
      find fhaosmo_ros studies -name '*.so' | LC_ALL=C sort; } | cksum
}
is_compiled() { [ "$(cat build/in_place 2>/dev/null)" = "$(compiled)" ]; }
is_compiled || [ -f "$headers/Python.h" ] ||
    fail "Python's headers are needed to compile the core, and $headers/Python.h is missing:" \
        "install them (Debian, Ubuntu: apt install ${headers##*/}-dev), or $other"

current() { [ -x "$bin/python" ] && [ "$(cat "$venv/made-$1" 2>/dev/null)" = "$origin" ]; }

make_venv() {
    # --clear, not rm: $python may be the one of this very environment, activated.
    if "$python" -c 'import ensurepip; ensurepip.version()' 2>/dev/null; then
        "$python" -m venv --clear $options "$venv"
    elif "$python" -m pip --version >/dev/null 2>&1; then
        # Debian splits ensurepip off into python3-venv; the pip outside can fill a bare venv.
        "$python" -m venv --clear --without-pip $options "$venv"
        "$python" -m pip --python "$bin/python" install -qq pip
    else
        fail "$python has neither ensurepip nor pip: install one (Debian: apt install python3-venv)"
    fi
    # To read setup.py with, and to compile (below).
    "$bin/python" -m pip install -qq 'Cython>=3' 'setuptools>=68,<80' ||
        fail "pip could not install Cython and setuptools (see above); is there a network?"
    # ROS's compiled modules want the numpy they were built against; the wheels' venv has none yet.
    "$bin/python" -c 'import numpy; print("numpy==" + numpy.__version__)' \
        >"$venv/constraints.txt" 2>/dev/null || :
    "$bin/python" -c '
import sys, sysconfig
with open(sysconfig.get_path("purelib") + "/fhaosmo_ros.pth", "w") as file:
    print(sys.argv[1], file=file)' "$root"
}

install() { # install run: the requirements of setup.py; install EXTRA: those of an extra
    "$bin/python" -c '
import sys, setuptools
from distutils.core import run_setup
setup = run_setup("setup.py", stop_after="init")
name = sys.argv[1]
print(*setup.install_requires if name == "run" else setup.extras_require[name], sep="\n")
' "$1" >"$venv/requirements-$1.txt"
    "$bin/python" -m pip install -qq --disable-pip-version-check \
        -r "$venv/requirements-$1.txt" -c "$venv/constraints.txt" ||
        fail "pip could not install what $venv/requirements-$1.txt lists (see above);" \
            "the ROS 2 wheels are for Linux on x86-64, elsewhere source a ROS 2 Jazzy"
}

compile() {
    if [ -z "$compiler" ]; then
        say 'There is no C compiler here: adding ziglang, which has one ...'
        "$bin/python" -m pip install -qq --disable-pip-version-check ziglang ||
            fail "pip could not install ziglang (see above): install gcc or clang"
        compiler="'$bin/python' -m ziglang cc"
    fi
    [ "$compiler" = "$own_compiler" ] || export CC="$compiler" LDSHARED="$compiler -shared"
    say 'Compiling the core; this takes about a minute ...'
    find fhaosmo_ros studies -name '*.so' | while read -r built; do  # of a source that is gone
        [ -f "${built%%.*}.pyx" ] || rm "$built"
    done
    "$bin/python" setup.py -q build_ext --inplace >&2 ||
        fail "the core could not be compiled (see above)"
    compiled >build/in_place
}

building=
if ! current run; then
    say "Making the environment $venv, once; this takes $cost ..."
    make_venv
    if [ -n "$compiler" ] && ! is_compiled; then  # downloads leave the cores free
        compile &
        building=$!
        trap 'kill "$building" 2>/dev/null || :' EXIT
        trap 'exit 130' INT TERM
    fi
    install run
    [ "$wheels" = no ] || install "ros-$wheels"
    "$bin/python" -c 'import rclpy' || fail "rclpy cannot be imported in $venv (see above)"
    printf '%s' "$origin" >"$venv/made-run"
fi
for extra; do
    if ! current "$extra"; then
        say "Adding the packages of [$extra] to $venv, once ..."
        install "$extra"
        printf '%s' "$origin" >"$venv/made-$extra"
    fi
done
if [ -n "$building" ]; then
    wait "$building" || exit 1
    trap - EXIT
elif ! is_compiled; then
    compile
fi
printf '%s\n' "$bin/python"
