import json
import threading
from queue import Queue

import httpx
import pytest

from skytether.lab.world.live import serve
from skytether.lab.world.plan import building
from skytether.lab.world.simulation import Simulation


@pytest.mark.slow
def test_the_page_is_served_on_loopback_only_by_its_own_name_and_the_world_goes_on() -> None:
    address, ended, world = Queue(), threading.Event(), Simulation(building(), seed=1)
    thread = threading.Thread(target=serve, args=(world, 0, address.put, ended))
    thread.start()
    try:
        url = address.get(timeout=30)
        assert url.startswith("http://127.0.0.1:")
        with httpx.Client(base_url=url) as client:
            assert "<canvas" in client.get("/").text
            plan = json.loads(client.get("/plan").text)
            assert len(plan["goals"]) == 9
            while client.get("/state").json()["time"] < 0.3:
                threading.Event().wait(0.02)
            state = client.get("/state").json()
            assert len(state["robots"]) == 1
            assert len(state["hits"]) > 50
            # A page from elsewhere whose name was made to lead here.
            assert client.get("/state", headers={"Host": "example.org:80"}).status_code == 404
            assert client.get("/etc/passwd").status_code == 404
            assert client.post("/state").status_code == 501
    finally:
        ended.set()
        thread.join()
