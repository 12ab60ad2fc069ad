"""Thousands of requests made from the OpenAPI document: no server error, no undocumented answer.

`make test-console` sends a few of each kind, `make test-console-long` 5,000 and more. CONSOLE_CASES
is how many each operation gets.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from live_console import API, LiveConsole
from schemathesis.checks import not_a_server_error
from schemathesis.core.result import Ok
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_schema_conformance,
    status_code_conformance,
)

pytestmark = pytest.mark.usefixtures("sensors")

CASES = int(os.environ.get("CONSOLE_CASES", "6"))
_CHECKS = [
    not_a_server_error, status_code_conformance, content_type_conformance,
    response_schema_conformance,
]  # fmt: skip
sent: Counter[int] = Counter()
_STARVED = 503
"""A machine that does much else lets a process miss its time; the answer says to try again."""
_TRIES, _PAUSE_S, _PATIENCE_S = 30, 1.0, 600.0


@pytest.fixture(scope="module")
def operations(console: LiveConsole, scans: list[dict[str, Any]]) -> list[Any]:
    """Operations of the running console but for the events, which never end."""
    assert scans
    schema = schemathesis.openapi.from_url(f"{console.url}{API}/openapi.json")
    listed = schema.exclude(path=f"{API}/events").get_all_operations()
    return [found.ok() for found in listed if isinstance(found, Ok)]


def test_every_answer_is_documented(
    operations: list[Any], console: LiveConsole, scans: list[dict[str, Any]]
) -> None:
    token = {"Authorization": f"Bearer {console.tokens['manage']}"}

    def send(case: Any) -> None:
        # Half of the requests are for a scan that there is.
        for name in ("scan_id", "other"):
            known = name in (case.path_parameters or {}) and case.method.upper() != "DELETE"
            if known and sum(sent.values()) % 2:
                case.path_parameters[name] = scans[0]["scan_id"]
        for _ in range(_TRIES):
            response = case.call(base_url=console.url, headers=token, timeout=_PATIENCE_S)
            sent[response.status_code] += 1
            if response.status_code != _STARVED:
                break
            time.sleep(_PAUSE_S)
        case.validate_response(response, checks=_CHECKS)

    failed = []
    for operation in operations:
        generated = settings(
            max_examples=CASES,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
            phases=[Phase.generate],
        )(given(case=operation.as_strategy())(send))
        try:
            generated()
        except Exception as error:
            # An answer that came once and not again is in a group.
            causes = getattr(error, "exceptions", ())
            failed.append(f"{operation.label}: {error} {causes}")
    assert failed == [], "\n\n".join(failed)


def test_the_station_is_unharmed(console: LiveConsole) -> None:
    """Runs last: everything still works."""
    print(f"{sum(sent.values())} requests: {dict(sorted(sent.items()))}")
    assert not any(status >= 500 and status != _STARVED for status in sent)
    with console.client() as client:
        client.delete("/task")
        console.station.wait_until(
            lambda: bool(client.get("/booth").json()["running"]), "the station runs"
        )
    console.start_sensors()
    assert console.scan("after all that")["state"] in ("delivered", "rescan")
