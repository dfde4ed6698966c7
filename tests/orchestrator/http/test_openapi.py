"""The whole API as it describes itself, with generated requests, good and bad: no answer is a 5xx."""

from __future__ import annotations

from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from schemathesis.checks import not_a_server_error

from skytether.api.rest import RobotCreate


@pytest.mark.slow
@pytest.mark.parametrize("who", ["operator", "robot", "nobody"])
def test_no_request_makes_a_server_error(served: Any, who: str) -> None:
    served.site("lab")
    token = {"operator": served.token, "nobody": None}.get(who)
    if who == "robot":
        token = served.operator.create_robot(RobotCreate(name="walker")).token
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    schema = schemathesis.openapi.from_url(f"{served.url}/openapi.json")
    failures = []
    for result in schema.get_all_operations():
        operation = result.ok()
        if operation.path.endswith("/events"):
            continue  # a stream that ends with its instance

        @settings(
            max_examples=8,
            derandomize=True,
            database=None,
            deadline=None,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(case=operation.as_strategy())
        def run(case: Any) -> None:
            response = case.call(base_url=served.url, headers=headers, timeout=30)
            case.validate_response(response, checks=(not_a_server_error,))

        try:
            run()
        except Exception as error:
            failures.append(f"{operation.method.upper()} {operation.path}: {error}")
    assert not failures, "\n\n".join(failures)[:8000]
