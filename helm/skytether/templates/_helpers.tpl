{{/* What the release's names begin with. */}}
{{- define "skytether.fullname" -}}
{{- $name := default .Chart.Name .Values.nameOverride -}}
{{- if .Values.fullnameOverride -}}
{{- .Values.fullnameOverride -}}
{{- else if contains $name .Release.Name -}}
{{- .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- else -}}
{{- printf "%s-%s" .Release.Name $name | trunc 40 | trimSuffix "-" -}}
{{- end -}}
{{- end -}}

{{/* By which a component's pods are found: list ROOT COMPONENT. */}}
{{- define "skytether.selector" -}}
{{- $root := index . 0 -}}
app.kubernetes.io/name: {{ default $root.Chart.Name $root.Values.nameOverride }}
app.kubernetes.io/instance: {{ $root.Release.Name }}
app.kubernetes.io/component: {{ index . 1 }}
{{- end -}}

{{/* Labels of an object: list ROOT COMPONENT MORE. Whatever is given, what pods are found by stays. */}}
{{- define "skytether.labels" -}}
{{- $root := index . 0 -}}
{{- $own := dict "app.kubernetes.io/managed-by" $root.Release.Service "app.kubernetes.io/part-of" "skytether" "app.kubernetes.io/version" $root.Chart.AppVersion "helm.sh/chart" (printf "%s-%s" $root.Chart.Name ($root.Chart.Version | replace "+" "_")) -}}
{{- toYaml (mergeOverwrite (dict) $root.Values.labels (index . 2) $own (fromYaml (include "skytether.selector" .))) -}}
{{- end -}}

{{/* Metadata of an object: dict root, name, component, labels, annotations. */}}
{{- define "skytether.metadata" -}}
name: {{ .name }}
namespace: {{ default .root.Release.Namespace .namespace }}
labels:
  {{- include "skytether.labels" (list .root .component (default (dict) .labels)) | nindent 2 }}
{{- with mergeOverwrite (dict) .root.Values.annotations (default (dict) .annotations) }}
annotations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{- define "skytether.image" -}}
{{- with .Values.image -}}
{{- .repository }}{{ if .digest }}@{{ .digest }}{{ else }}:{{ required "image: give a tag or a digest" .tag }}{{ end -}}
{{- end -}}
{{- end -}}

{{/* Nobody of ours owns `skytether/` at the public index: a node must not ask there for whoever took it. */}}
{{- define "skytether.pullPolicy" -}}
{{- with .Values.image -}}
{{- if and (not .digest) (regexMatch "^((index\\.)?docker\\.io/)?skytether/" .repository) }}Never{{ else }}{{ .pullPolicy }}{{ end -}}
{{- end -}}
{{- end -}}

{{- define "skytether.account" -}}
{{- if .Values.serviceAccount.create -}}
{{- default (printf "%s-orchestrator" (include "skytether.fullname" .)) .Values.serviceAccount.name -}}
{{- else -}}
{{- default "default" .Values.serviceAccount.name -}}
{{- end -}}
{{- end -}}

{{- define "skytether.secret" -}}
{{- default (printf "%s-secrets" (include "skytether.fullname" .)) .Values.secrets.existingSecret -}}
{{- end -}}

{{/* A DNS label that is different for releases of one name in two namespaces, for what belongs to no namespace. */}}
{{- define "skytether.everywhere" -}}
{{- printf "%s-%s" .Release.Namespace (include "skytether.fullname" .) -}}
{{- end -}}

{{/* The sites as the orchestrator is told them: those in this cluster with their namespace and owner. */}}
{{- define "skytether.sites" -}}
{{- $sites := dict -}}
{{- range $name, $site := .Values.sites -}}
{{- $options := default (dict) $site.options -}}
{{- if and (eq $site.runtime "kubernetes") (not $options.kubeconfig) -}}
{{- $own := dict "namespace" $.Release.Namespace "owner" (printf "%s-%s" $.Release.Name $name | trunc 32 | trimSuffix "-") -}}
{{- $options = mergeOverwrite $own $options -}}
{{- end -}}
{{- $_ := set $sites $name (merge (dict "options" $options) (omit $site "options")) -}}
{{- end -}}
{{- toYaml $sites -}}
{{- end -}}

{{/* Those of them that are in this cluster. */}}
{{- define "skytether.sitesHere" -}}
{{- $here := dict -}}
{{- range $name, $site := fromYaml (include "skytether.sites" .) -}}
{{- if and (eq $site.runtime "kubernetes") (not $site.options.kubeconfig) -}}
{{- $_ := set $here $name $site -}}
{{- end -}}
{{- end -}}
{{- toYaml $here -}}
{{- end -}}

{{/* The namespaces of these. */}}
{{- define "skytether.namespaces" -}}
{{- $names := list -}}
{{- range fromYaml (include "skytether.sitesHere" .) -}}
{{- $names = append $names .options.namespace -}}
{{- end -}}
{{- toJson ($names | uniq | sortAlpha) -}}
{{- end -}}

{{/* What a site in this cluster needs: docs/kubernetes.md, which a test holds beside it. */}}
{{- define "skytether.rules" -}}
- {apiGroups: [""], resources: [pods], verbs: [get, list, watch, create, patch, delete]}
- {apiGroups: [""], resources: [pods/log, pods/proxy], verbs: [get]}
- {apiGroups: [""], resources: [pods/resize], verbs: [patch]}
- {apiGroups: [""], resources: [secrets], verbs: [get, create, delete]}
- {apiGroups: [""], resources: [services], verbs: [list, create, patch, delete]}
- {apiGroups: [""], resources: [persistentvolumeclaims], verbs: [create, delete]}
- {apiGroups: [""], resources: [configmaps], verbs: [get, create, update, delete]}
- {apiGroups: [networking.k8s.io], resources: [networkpolicies], verbs: [list, create, patch, delete]}
- {apiGroups: [policy], resources: [poddisruptionbudgets], verbs: [create, patch, delete]}
- {apiGroups: [metrics.k8s.io], resources: [pods], verbs: [list]}
{{- end -}}

{{- define "skytether.scheme" -}}
{{- if .Values.orchestrator.tlsSecret -}}https{{- else -}}http{{- end -}}
{{- end -}}

{{/* Top of a Deployment's spec, and its pods' metadata and where they go: dict root, component, values, annotations, account. */}}
{{- define "skytether.pod" -}}
{{- $selector := include "skytether.selector" (list .root .component) -}}
selector:
  matchLabels:
    {{- $selector | nindent 4 }}
template:
  metadata:
    labels:
      {{- omit (fromYaml (include "skytether.labels" (list .root .component .values.podLabels))) "helm.sh/chart" | toYaml | nindent 6 }}
    {{- with mergeOverwrite (dict) .root.Values.annotations (default (dict) .annotations) .values.podAnnotations }}
    annotations:
      {{- toYaml . | nindent 6 }}
    {{- end }}
  spec:
    {{- if .account }}
    serviceAccountName: {{ .account }}
    {{- else }}
    automountServiceAccountToken: false
    {{- end }}
    enableServiceLinks: false
    {{- with .root.Values.image.pullSecrets }}
    imagePullSecrets:
      {{- range . }}
      - name: {{ . }}
      {{- end }}
    {{- end }}
    {{- with .root.Values.podSecurityContext }}
    securityContext:
      {{- toYaml . | nindent 6 }}
    {{- end }}
    terminationGracePeriodSeconds: {{ .values.terminationGracePeriodSeconds }}
    {{- with .values.priorityClassName }}
    priorityClassName: {{ . }}
    {{- end }}
    {{- with .values.nodeSelector }}
    nodeSelector:
      {{- toYaml . | nindent 6 }}
    {{- end }}
    {{- with .values.tolerations }}
    tolerations:
      {{- toYaml . | nindent 6 }}
    {{- end }}
    {{- with .values.affinity }}
    affinity:
      {{- toYaml . | nindent 6 }}
    {{- end }}
    topologySpreadConstraints:
      {{- if .values.topologySpreadConstraints }}
      {{- toYaml .values.topologySpreadConstraints | nindent 6 }}
      {{- else }}
      - maxSkew: 1
        topologyKey: kubernetes.io/hostname
        whenUnsatisfiable: ScheduleAnyway
        labelSelector:
          matchLabels:
            {{- $selector | nindent 12 }}
      {{- end }}
{{- end -}}

{{/* What all containers have: dict root, values. */}}
{{- define "skytether.container" -}}
image: {{ include "skytether.image" .root | quote }}
imagePullPolicy: {{ include "skytether.pullPolicy" .root }}
{{- with .root.Values.securityContext }}
securityContext:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .values.resources }}
resources:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .values.envFrom }}
envFrom:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end -}}

{{/* Spec of a Service: dict root, component, service, port (name, protocol). */}}
{{- define "skytether.service" -}}
type: {{ .service.type }}
{{- if ne .service.type "ClusterIP" }}
{{- with .service.externalTrafficPolicy }}
externalTrafficPolicy: {{ . }}
{{- end }}
{{- end }}
{{- if eq .service.type "LoadBalancer" }}
{{- if and .service.loadBalancerClass (semverCompare ">=1.24-0" .root.Capabilities.KubeVersion.Version) }}
loadBalancerClass: {{ .service.loadBalancerClass }}
{{- end }}
{{- with .service.loadBalancerSourceRanges }}
loadBalancerSourceRanges:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}
selector:
  {{- include "skytether.selector" (list .root .component) | nindent 2 }}
ports:
  - name: {{ .name }}
    protocol: {{ .protocol }}
    port: {{ .service.port }}
    targetPort: {{ .name }}
    {{- if and .service.nodePort (ne .service.type "ClusterIP") }}
    nodePort: {{ .service.nodePort }}
    {{- end }}
{{- end -}}

{{/* A PodDisruptionBudget: dict root, component, values. */}}
{{- define "skytether.budget" -}}
{{- if .values.podDisruptionBudget.enabled }}
---
apiVersion: {{ if semverCompare ">=1.21-0" .root.Capabilities.KubeVersion.Version }}policy/v1{{ else }}policy/v1beta1{{ end }}
kind: PodDisruptionBudget
metadata:
  {{- include "skytether.metadata" (dict "root" .root "name" (printf "%s-%s" (include "skytether.fullname" .root) .component) "component" .component) | nindent 2 }}
spec:
  maxUnavailable: {{ .values.podDisruptionBudget.maxUnavailable }}
  selector:
    matchLabels:
      {{- include "skytether.selector" (list .root .component) | nindent 6 }}
{{- end }}
{{- end -}}

{{/* What of the given values will not do as it seems: a sentence a line. */}}
{{- define "skytether.warnings" -}}
{{- $shared := ne .Values.database.existingSecret "" -}}
{{- $here := fromYaml (include "skytether.sitesHere" .) -}}
{{- if not .Values.sites }}
sites: there is none, so no instance can run; add one to `sites`, or with `skytether site add`.
{{- end }}
{{- if and (not $shared) (not .Values.persistence.enabled) }}
persistence.enabled is false: robots, tokens and instances are forgotten when the orchestrator's pod ends.
{{- end }}
{{- if and $shared (lt (int .Values.orchestrator.replicas) 2) (not .Values.nodes.enabled) }}
orchestrator.replicas is {{ .Values.orchestrator.replicas }}: PostgreSQL lets two share the work, of which one takes over within 2.4 s.
{{- end }}
{{- if and $shared .Values.persistence.existingClaim }}
persistence.existingClaim is not used: the state is in PostgreSQL.
{{- end }}
{{- if and .Values.ingress.enabled (not .Values.ingress.tls) }}
ingress.tls is empty: robots and commands ask no http:// address beyond their own machine, unless they are told to (insecure_http).
{{- end }}
{{- if and (or .Values.ingress.enabled .Values.gateway.enabled) (not .Values.config.proxies) }}
config.proxies is empty: behind an ingress or a gateway all robots are one address to rate limits and audit; name its pods' network.
{{- end }}
{{- if and (ne .Values.orchestrator.service.type "ClusterIP") (not .Values.orchestrator.tlsSecret) }}
orchestrator.service.type is {{ .Values.orchestrator.service.type }} without orchestrator.tlsSecret: tokens and keys of sessions can be read on the way.
{{- end }}
{{- if and .Values.nodes.enabled .Values.uninstall.dismantle }}
nodes.enabled: `helm uninstall` does not reach what runs at machines that joined; `skytether site remove NAME` each before.
{{- end }}
{{- range $component := list "orchestrator" "nodes" "relay" "echo" }}
{{- if and (index $.Values $component "service" "loadBalancerClass") (semverCompare "<1.24-0" $.Capabilities.KubeVersion.Version) }}
{{ $component }}.service.loadBalancerClass is left out: this cluster is older than Kubernetes 1.24, which begins to know it.
{{- end }}
{{- end }}
{{- if .Values.config.open_metrics }}
config.open_metrics is true: whoever reaches the API reads what robots do.
{{- end }}
{{- if and (not .Values.image.digest) (eq .Values.image.tag "latest") }}
image.tag is 'latest': pods that start later may run another version; give a version or a digest.
{{- end }}
{{- range $name, $site := $here }}
{{- $reach := default "hostport" $site.options.reach }}
{{- if eq $reach "hostport" }}
sites.{{ $name }}.options.reach is hostport: a namespace with Pod Security `baseline` or `restricted` refuses its pods; nodeport, loadbalancer and pod pass.
{{- end }}
{{- if and (not $.Values.rbac.nodes) (not (and $site.options.cpu $site.options.memory_mb)) }}
sites.{{ $name }}: without rbac.nodes it wants options.cpu and options.memory_mb, or it is unreachable.
{{- end }}
{{- if and (not $.Values.rbac.nodes) (not $site.options.advertise_host) (has $reach (list "hostport" "nodeport")) }}
sites.{{ $name }}: without rbac.nodes no node's external address is known; give options.advertise_host.
{{- end }}
{{- end }}
{{- if and $here (not .Values.rbac.create) }}
rbac.create is false: give the service account {{ include "skytether.account" . }} the roles of docs/kubernetes.md; `helm uninstall` leaves the instances.
{{- end }}
{{- $relayed := list }}
{{- range $name, $site := $here }}
{{- if eq (default "hostport" $site.options.reach) "relay" }}{{ $relayed = append $relayed $name }}{{ end }}
{{- end }}
{{- if and .Values.relay.enabled (not $relayed) }}
relay is enabled and no site uses it: give one of `sites` options.reach relay and options.relay ADDRESS:{{ .Values.relay.service.port }}, with the address of service {{ include "skytether.fullname" . }}-relay.
{{- end }}
{{- if and .Values.relay.enabled .Values.relay.autoscaling.enabled (not (index .Values.relay.resources "requests")) }}
relay.autoscaling has nothing to go by: give relay.resources.requests.cpu.
{{- end }}
{{- if and .Values.prometheusRule.enabled (not .Values.serviceMonitor.enabled) }}
prometheusRule is enabled and serviceMonitor is not: SkytetherDown fires until something is scraped as job 'skytether'.
{{- end }}
{{- end -}}
