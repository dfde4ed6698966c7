#!/bin/sh
# setup.sh SSH... COMMAND: runs the command by SSH with the variable SETUP as its input, once the machine answers.
set -eu
deadline=$(($(date +%s) + MINUTES * 60))
while :; do
  status=0
  printf '%s\n' "$SETUP" | "$@" || status=$?
  # 255 is SSH's own: the machine is not up yet.
  [ $status = 255 ] || exit $status
  if [ "$(date +%s)" -ge "$deadline" ]; then
    echo "the machine was not reached by SSH within $MINUTES min (by: $*)" >&2
    exit 1
  fi
  sleep 3
done
