#!/bin/sh
# The chart on the cluster: install (also an upgrade), uninstall. Helm runs here, and speaks to the cluster through SSH: its
# API is open to the cluster's own nodes only. The kubeconfig is in a
# folder of this user's alone that is gone afterwards.
set -eu

say() { echo "cluster: $1"; }
fail() { echo "cluster: $1" >&2; exit 1; }
command -v helm >/dev/null || fail "helm is missing here: the chart is installed from the machine that runs Terraform"
folder=$(mktemp -d)
chmod 0700 "$folder"
trap 'eval "$SSH -S \"\$folder/ssh\" -O exit \"\$SERVER\"" >/dev/null 2>&1 || true; rm -rf "$folder"' EXIT INT TERM

through() {
  # A port of this machine that leads to the API on the server; the next one where somebody has it.
  port=16443
  until eval "$SSH -f -N -M -S \"\$folder/ssh\" -o ExitOnForwardFailure=yes -L \"127.0.0.1:\$port:127.0.0.1:6443\" \"\$SERVER\"" 2>"$folder/why"; do
    port=$((port + 1))
    [ "$port" -lt 16463 ] || fail "the API of $SERVER is not reached through SSH: $(cat "$folder/why")"
  done
  eval "$SSH \"\$SERVER\" sudo cat /etc/rancher/k3s/k3s.yaml" </dev/null | sed "s#127.0.0.1:6443#127.0.0.1:$port#" >"$folder/kubeconfig"
  chmod 0600 "$folder/kubeconfig"
  export KUBECONFIG="$folder/kubeconfig"
}

install() {
  through
  number=100
  for document in $VALUES; do
    number=$((number + 1))
    printf %s "$document" | base64 -d >"$folder/values-$number.yaml"
  done
  set -- upgrade --install "$RELEASE" "$CHART" --namespace "$NAMESPACE" --create-namespace --wait --timeout "${WAIT_MINUTES}m"
  for file in "$folder"/values-*.yaml; do
    [ ! -e "$file" ] || set -- "$@" --values "$file"
  done
  helm "$@"
}

uninstall() {
  through
  if ! helm status "$RELEASE" --namespace "$NAMESPACE" >/dev/null 2>&1; then say "the release is gone already"; return; fi
  helm uninstall "$RELEASE" --namespace "$NAMESPACE" --wait --timeout "${WAIT_MINUTES}m"
}

"$1"
