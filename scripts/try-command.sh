#!/usr/bin/env bash
# Fit a log and report on it with an installed icrtool, away from its source: try-command.sh ICRTOOL [LOG OPTION...].
# Without a log that is `icrtool demo`, which calls the same two commands on the log of the package.
set -euo pipefail
command=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
shift
run=icrtool-runs/demo
if [[ $# -gt 0 ]]; then
    log=$(cd "$(dirname "$1")" && pwd)/$(basename "$1")
    shift
    run=run
fi
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
cd "$scratch"
"$command" --help >help.txt
if [[ -n ${log:-} ]]; then
    "$command" fit "$log" "$@" -o run
    "$command" dropout-report run
else
    "$command" demo
fi
for result in help.txt "$run"/{run.json,states.csv,plots/trajectory.png,plots/icr_estimates.png,report.html} \
    "$run"/dropout/{summary.csv,plots/summary.png}; do
    [[ -s $result ]] || { echo "try-command: $result is missing" >&2; exit 1; }
done
