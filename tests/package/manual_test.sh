#!/usr/bin/env bash
# Every command and every option that boothctl and boothd have at the top is in their page of the manual, and bash
# completes the commands.
#
#   manual_test.sh BIN_DIR SOURCE_DIR
set -euo pipefail
bin=$1 source=$2
status=0
for program in boothctl boothd; do
  page=$(sed 's/\\-/-/g' "$source/daemon/man/$program.1")
  words=$("$bin/$program" --help | sed -n 's/^  \([a-z][a-z-]*\) .*/\1/p; s/.*\(--[a-z][a-z-]*\).*/\1/p')
  [ "$(wc -w <<<"$words")" -gt 2 ] || { echo "the help of $program is not understood"; exit 1; }
  for word in $words; do
    grep -qwe "$word" <<<"$page" || { echo "$program.1 does not mention $word"; status=1; }
  done
done

PATH=$bin:$PATH
. "$source/systemd/package/boothctl.bash-completion"
complete_words() {
  COMP_WORDS=("$@") COMP_CWORD=$(($# - 1)) COMPREPLY=()
  _boothctl
  echo "${COMPREPLY[*]}"
}
expect() {
  local wanted=$1
  shift
  [[ " $(complete_words "$@") " == *" $wanted "* ]] || { echo "'$*' is not completed to $wanted"; status=1; }
}
expect status boothctl sta
expect fetch boothctl avatars f
expect --role boothctl keys add --ro
expect operator boothctl keys add --role o
exit $status
