{{- define "wearline.name" -}}
{{- printf "%s" .Release.Name | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{- define "wearline.labels" -}}
app.kubernetes.io/name: wearline
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .name }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
wearline/cell: {{ .root.Values.cell }}
{{- end -}}

{{- define "wearline.selector" -}}
app.kubernetes.io/name: wearline
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .name }}
{{- end -}}

{{- define "wearline.image" -}}
{{ printf "%s/%s:%s" .root.Values.image.registry .image (.root.Values.image.tag | default .root.Chart.AppVersion) }}
{{- end -}}

{{/* Port of /metrics, /healthz and /livez. */}}
{{- define "wearline.metricsPort" -}}
{{- get (dict "capture" "9101" "reconstruct" "9102" "judge" "9103" "fieldbus" "9104" "hmi" "9105") . -}}
{{- end -}}

{{- define "wearline.scheme" -}}
{{- if .Values.certificates.enabled -}}tls{{- else -}}tcp{{- end -}}
{{- end -}}

{{/* What every pod has. */}}
{{- define "wearline.pod" -}}
serviceAccountName: {{ include "wearline.name" .root }}
automountServiceAccountToken: false
enableServiceLinks: false
terminationGracePeriodSeconds: 10
{{- with .root.Values.priorityClassName }}
priorityClassName: {{ . }}
{{- end }}
{{- with .root.Values.image.pullSecrets }}
imagePullSecrets:
{{- range . }}
  - name: {{ . }}
{{- end }}
{{- end }}
{{- with .place.nodeSelector }}
nodeSelector: {{- toYaml . | nindent 2 }}
{{- end }}
tolerations:
  # A node that is gone gives its pods up after 20 s instead of 300.
  - {key: node.kubernetes.io/unreachable, operator: Exists, effect: NoExecute, tolerationSeconds: 20}
  - {key: node.kubernetes.io/not-ready, operator: Exists, effect: NoExecute, tolerationSeconds: 20}
{{- with .place.tolerations }}
{{ toYaml . | indent 2 }}
{{- end }}
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  fsGroupChangePolicy: OnRootMismatch
  seccompProfile: {type: RuntimeDefault}
{{- end -}}

{{/* What every container has: image, no rights, the cell's file, /tmp, certificates. */}}
{{- define "wearline.container" -}}
image: {{ include "wearline.image" . }}
imagePullPolicy: {{ .root.Values.image.pullPolicy }}
securityContext:
  allowPrivilegeEscalation: false
  privileged: false
  readOnlyRootFilesystem: true
  runAsNonRoot: true
  runAsUser: 10001
  capabilities: {drop: [ALL]}
  seccompProfile: {type: RuntimeDefault}
{{- end -}}

{{- define "wearline.mounts" -}}
- {name: cell, mountPath: /etc/wearline/cell.yaml, subPath: cell.yaml, readOnly: true}
- {name: tmp, mountPath: /tmp}
{{- if .root.Values.certificates.enabled }}
{{- if has .name (list "router" "capture" "reconstruct" "judge" "fieldbus" "hmi") }}
- {name: certificates, mountPath: /etc/wearline/certificates, readOnly: true}
{{- end }}
{{- end }}
{{- end -}}

{{- define "wearline.volumes" -}}
- name: cell
  configMap: {name: {{ include "wearline.name" .root }}-cell}
- name: tmp
  emptyDir: {sizeLimit: 64Mi}
{{- if .root.Values.certificates.enabled }}
{{- if has .name (list "router" "capture" "reconstruct" "judge" "fieldbus" "hmi") }}
- name: certificates
  secret: {secretName: {{ .root.Values.certificates.secretPrefix }}{{ .name }}, defaultMode: 0440}
{{- end }}
{{- end }}
{{- end -}}

{{- define "wearline.probes" -}}
startupProbe:
  httpGet: {path: /healthz, port: metrics}
  periodSeconds: 2
  failureThreshold: 60
readinessProbe:
  httpGet: {path: /healthz, port: metrics}
  periodSeconds: 5
  timeoutSeconds: 3
livenessProbe:
  # Only its own loop: no router, camera or PLC is mended by killing a service.
  httpGet: {path: /livez, port: metrics}
  periodSeconds: 5
  timeoutSeconds: 3
  failureThreshold: 3
{{- end -}}

{{/* A changed cell.yaml starts the pods anew. */}}
{{- define "wearline.checksum" -}}
checksum/cell: {{ include (print $.Template.BasePath "/cell.yaml") . | sha256sum }}
{{- end -}}

{{- define "wearline.claim" -}}
accessModes: [ReadWriteOnce]
{{- with .className }}
storageClassName: {{ . }}
{{- end }}
resources:
  requests:
    storage: {{ .size }}
{{- end -}}
