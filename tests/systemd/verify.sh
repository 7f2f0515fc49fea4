#!/usr/bin/env bash
# The unit is understood by systemd as a whole.
#
#   verify.sh UNIT
set -euo pipefail
complaints=$(systemd-analyze verify --man=no "$1" 2>&1 | grep -F "$(basename "$1")" | grep -vF 'is not executable' || true)
[ -z "$complaints" ] || { echo "$complaints"; exit 1; }
