#!/usr/bin/env bash
# Install icrtool from this checkout into a new environment DIR, with all kernels compiled for any processor of this
# architecture: container-setup.sh DIR [EXTRA...]. Needs Python 3.11 or newer (PYTHON=... names another one) and no
# privilege. Then `. DIR/bin/activate`; from there on DIR may be read-only.
set -euo pipefail
source=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
place=${1:?container-setup.sh DIR [EXTRA...]}
shift
python=${PYTHON:-python3}

"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Error: Python " + sys.version.split()[0] + ": too old; icrtool needs 3.11 or newer: PYTHON=python3.11 container-setup.sh ...")'
# uv, where there is one, installs in a quarter of pip's CPU time, and the environment needs no pip (5 s of CPU time).
# Where uv fails, as with an index set for pip, and to resolve extras, pip is added.
uv=$(command -v uv || true)
"$python" -m venv "$place" ${uv:+--without-pip}
place=$(cd "$place" && pwd)
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
# `cache warm` compiles the modules that it loads: all of them would take as long as the rest.
export PYTHONDONTWRITEBYTECODE=
has_pip=${uv:-yes}
add_pip() {
    [[ $has_pip == yes ]] || "$place/bin/python" -m ensurepip >/dev/null
    has_pip=yes
}
install() {
    if [[ -n $uv ]] && "$uv" pip install --quiet --no-config --no-deps --python "$place/bin/python" "$@"; then
        return
    fi
    add_pip
    "$place/bin/python" -m pip --disable-pip-version-check install --quiet --no-compile --no-deps "$@"
}

[[ $# -eq 0 ]] || add_pip
"$place/bin/python" "$source/scripts/pinned_requirements.py" "$@" >"$scratch/pinned.txt"
install --require-hashes -r "$scratch/pinned.txt"
install --no-build-isolation "$source"

cat >>"$place/bin/activate" <<'ACTIVATE'

# Kernels of icrtool, compiled for any processor of this architecture
export NUMBA_CACHE_DIR="$VIRTUAL_ENV/kernels" NUMBA_CPU_NAME=generic
ACTIVATE
. "$place/bin/activate"
cd /
icrtool cache warm
