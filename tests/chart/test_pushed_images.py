"""What ``images/build.py --push --digests`` writes for the chart."""

from __future__ import annotations

import yaml
from helm_chart import at, objects
from image_push import Pushed, values

DIGEST = f"sha256:{'ab' * 32}"


def test_the_chart_has_what_was_pushed_by_digest() -> None:
    names = ["base", "guard", "orchestrator", "ros1-base", "virtual-trail", "follow-in-front", "navigation", "recorder"]
    rows = [Pushed(f"registry.example/lab/{name}", ("1", "0.1.0"), DIGEST, {}, ()) for name in names]
    written = yaml.safe_load(yaml.safe_dump(values(rows)))
    made = objects(written)
    container = at(made["Deployment/orchestrator"], "spec template spec containers orchestrator")
    assert container["image"] == f"registry.example/lab/orchestrator@{DIGEST}"
    (catalog,) = (one for key, one in made.items() if key.startswith("ConfigMap/") and key.endswith("catalog"))
    images = {yaml.safe_load(text)["spec"]["image"] for text in catalog["data"].values()}
    assert images == {f"registry.example/lab/{name}@{DIGEST}" for name in names[4:]}
