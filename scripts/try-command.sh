#!/usr/bin/env bash
# Fit a log and report on it with an installed icrtool, away from its source: try-command.sh ICRTOOL LOG [OPTION...]
set -euo pipefail
command=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
log=$(cd "$(dirname "$2")" && pwd)/$(basename "$2")
shift 2
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cd "$scratch"
"$command" --help >help.txt
"$command" fit "$log" "$@" -o run
"$command" dropout-report run
for result in help.txt run/run.json run/states.csv run/plots/trajectory.png run/plots/icr_estimates.png \
    run/dropout/summary.csv run/dropout/plots/summary.png run/report.html; do
    [[ -s $result ]] || { echo "try-command: $result is missing" >&2; exit 1; }
done
