#!/usr/bin/env bash
# Build the wheel from a clean source archive, install it alone in a fresh environment, and run the demo there.
# A package file that was left out of the wheel, or an import of a development package, fails here and nowhere else.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-python3}
build_python=${BUILD_PYTHON:-.venv/bin/python}
read -r -a demo_options <<<"${DEMO_OPTIONS:-}"
demo_log=${DEMO_LOG:-}
if [[ ! -e $demo_log ]]; then
    echo "check-wheel: no demo log; set DEMO_LOG" >&2
    exit 1
fi

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
bin=$scratch/venv/bin

echo "check-wheel: build"
"$build_python" -m build --outdir "$scratch/dist" . >"$scratch/build.log" 2>&1 || { cat "$scratch/build.log" >&2; exit 1; }
wheel=$(ls "$scratch"/dist/*.whl)
"$build_python" -m zipfile --list "$wheel" >"$scratch/contents"
git ls-files --cached --others --exclude-standard icrtool | while read -r file; do
    [[ ! -e $file ]] || grep -qF "$file " "$scratch/contents" || { echo "check-wheel: $file is not in the wheel" >&2; exit 1; }
done

# pip cannot hold a local wheel's dependencies to hashes; the same files passed that test in `make setup`.
echo "check-wheel: install"
sed -E -e '/^ +--hash/d' -e 's/ *\\$//' constraints.txt >"$scratch/pins.txt"
"$python" -m venv "$scratch/venv"
"$bin/python" -m pip install --quiet --disable-pip-version-check --no-compile --constraint "$scratch/pins.txt" "$wheel"
"$bin/python" -m pip check --disable-pip-version-check >/dev/null

echo "check-wheel: run"
cp -R sample_logs "$scratch/sample_logs"
[[ $demo_log == sample_logs/* ]] || cp "$demo_log" "$scratch/"
[[ $demo_log == sample_logs/* ]] || demo_log=$(basename "$demo_log")
cd "$scratch"
"$bin/python" -I -c 'import icrtool, sys; sys.exit(not icrtool.__file__.startswith(sys.prefix))'
"$bin/icrtool" --help >/dev/null
"$bin/icrtool" fit "$demo_log" ${demo_options[@]+"${demo_options[@]}"} -o run
"$bin/icrtool" dropout-report run
for result in run/run.json run/states.csv run/plots/trajectory.png run/plots/icr_estimates.png \
    run/dropout/summary.csv run/dropout/plots/summary.png run/report.html; do
    [[ -s $result ]] || { echo "check-wheel: $result is missing" >&2; exit 1; }
done
echo "check-wheel: the wheel works"
