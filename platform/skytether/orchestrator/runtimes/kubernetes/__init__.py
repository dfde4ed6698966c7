"""A Kubernetes cluster as a site. Each run of an instance is a pod.

``options`` what a site is told, ``cluster`` calls to the API server, ``objects`` what is asked of it and ``seen`` what
its answers mean (both pure), ``watch`` what is known of the pods and ``nodes`` of the nodes, ``services`` how a pod is
reached, ``reports`` and ``usage`` what is told of it while it runs, ``budget`` that drains wait for it, ``fence`` who
leads, ``runtime`` the calls of the contract.
"""

from .runtime import KubernetesRuntime

__all__ = ["KubernetesRuntime"]
