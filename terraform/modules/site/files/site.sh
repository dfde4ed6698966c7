#!/bin/sh
# Makes a machine a site (join), or takes it out again (leave). The join token goes through pipes: it is in no file, no
# argument and no environment.
set -eu

say() { echo "site $NAME: $1"; }
fail() { echo "site $NAME: $1" >&2; exit 1; }
run() { eval "$CLI \"\$@\""; }
deadline=$(($(date +%s) + $(awk "BEGIN { print int($WAIT_MINUTES * 60) }")))
late() { [ "$(date +%s)" -ge "$deadline" ]; }
known() { run site list --json | grep -q "\"name\": *\"$NAME\""; }
state() { run site show "$NAME" --json | grep -o '"state": *"[a-z]*"' | head -n 1 | sed 's/.*"\([a-z]*\)"$/\1/'; }

join() {
  until run site list --json >/dev/null 2>&1; do
    if late; then
      run site list --json >/dev/null || true
      fail "the orchestrator did not answer within $WAIT_MINUTES min (by: $CLI site list)"
    fi
    sleep 2
  done
  if known; then fail "there is a site of this name already: choose another, or 'skytether site remove $NAME' first"; fi
  token=$(run site invite "$NAME" --tier "$TIER" --valid "$VALID") || fail "there is no join token, for the reason above"
  say "the token is brought to the machine"
  while :; do
    status=0
    printf '%s\n' "$token" | eval "$DELIVER" || status=$?
    # 255 is SSH's own: the machine is not up yet.
    [ $status = 255 ] || break
    if late; then fail "the machine was not reached within $WAIT_MINUTES min (by: $DELIVER)"; fi
    sleep 3
  done
  [ $status = 0 ] || fail "the machine has not joined, for the reason above (exit status $status of: $DELIVER)"
  # From here on it may have joined. If it is not taken for a site, nothing of that is left.
  trap 'status=$?; if [ $status != 0 ]; then run site remove "$NAME" --force >/dev/null 2>&1 || true; fi' EXIT
  until [ "$(state 2>/dev/null)" = ready ]; do
    if late; then fail "the machine has its token and did not become a ready site within $WAIT_MINUTES min; on the machine: sudo journalctl -u 'skytether*'"; fi
    sleep 2
  done
  if [ -n "$FORGET" ]; then eval "$FORGET"; fi
  say "ready"
}

leave() {
  if ! run site list --json >/dev/null; then fail "the orchestrator does not answer, so the site cannot be drained (by: $CLI site list)"; fi
  if ! known; then
    say "it is no site any more"
    return
  fi
  seconds=$(awk "BEGIN { print int($WAIT_MINUTES * 60) }")
  run site drain "$NAME" --timeout-s "$seconds" || fail "it still has instances after $WAIT_MINUTES min: end them, or make room elsewhere, and destroy again"
  run site remove "$NAME" --timeout-s "$seconds"
}

"$1"
