"""Images into a registry: packed to the same bytes, for several architectures, with what each is made of."""

from __future__ import annotations

import io
import json
import socket
import subprocess
import sys
import tarfile
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import Any

import httpx
import image_registry
import pytest
from docker_runs import docker, launch, until_phase
from docker_site import DockerSite
from image_layers import Manifest, Packer
from image_push import Pusher
from image_registry import INDEX, Registry, RegistryError, digest_of, split
from registry_server import log_in, passwords, registry, token_server

from skytether.orchestrator.runtimes.base import Phase

ROOT = Path(__file__).parents[2]
DAY = 86400
BUILT = 1_800_000_000
REVISION = "org.opencontainers.image.revision"


def tar(*files: tuple[str, bytes, int]) -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as made:
        for name, content, mtime in files:
            entry = tarfile.TarInfo(name)
            entry.size, entry.mtime = len(content), mtime
            made.addfile(entry, io.BytesIO(content))
    return buffer.getvalue()


def saved(built: int, architecture: str = "amd64", revision: str = "c0ffee") -> bytes:
    """What ``docker save`` writes of an image with Debian's layer and one more, built at a time."""
    when = f"{datetime.fromtimestamp(built, UTC):%Y-%m-%dT%H:%M:%S}"
    layers = [tar(("debian", b"12", BUILT)), tar(("made", b"1", built - 5), ("package.py", b"2", BUILT - 90 * DAY))]
    config = {
        "architecture": architecture,
        "os": "linux",
        "created": f"{when}.123456789Z",
        "container": f"made at {built}",
        "config": {
            "Image": f"sha256:{built}",
            "User": "65532",
            "Entrypoint": ["/x"],
            "Cmd": None,
            "Labels": {REVISION: revision, "org.opencontainers.image.created": "2026-01-01T00:00:00Z", "other": "1"},
        },
        "rootfs": {"type": "layers", "diff_ids": [digest_of(layer) for layer in layers]},
        "history": [
            {"created": "2026-01-01T00:00:00Z"},
            {"created": f"{when}.1Z", "created_by": "RUN"},
            {"created": f"{when}.2Z", "empty_layer": True},
        ],
    }
    listed = [{"Config": "config.json", "Layers": ["a/layer.tar", "b/layer.tar"]}]
    files = {"a/layer.tar": layers[0], "b/layer.tar": layers[1], "config.json": json.dumps(config).encode()}
    return tar(*((name, body, 0) for name, body in {**files, "manifest.json": json.dumps(listed).encode()}.items()))


DEBIAN = frozenset({digest_of(tar(("debian", b"12", BUILT)))})


def packed(folder: Path, content: bytes) -> Manifest:
    folder.mkdir()
    (folder / "saved.tar").write_bytes(content)
    return Packer(folder).image(folder / "saved.tar", DEBIAN)


def test_the_same_image_built_on_another_day_has_the_same_digest(tmp_path: Path) -> None:
    one, two = packed(tmp_path / "1", saved(BUILT)), packed(tmp_path / "2", saved(BUILT + 3 * DAY))
    assert one.body == two.body
    assert packed(tmp_path / "3", saved(BUILT, revision="beef")).digest != one.digest
    manifest = json.loads(one.body)
    assert manifest["annotations"] == {REVISION: "c0ffee", "org.opencontainers.image.created": "2026-01-01T00:00:00Z"}
    config = one.blobs[one.config]
    assert isinstance(config, bytes)
    told = json.loads(config)
    assert told["config"]["User"] == "65532"
    assert told["created"] == "2026-01-01T00:00:00Z"
    assert "container" not in told
    assert told["rootfs"]["diff_ids"][0] in DEBIAN, "nodes that have Debian's layer have it already"
    layers = [one.blobs[row["digest"]] for row in manifest["layers"]]
    times = []
    for path in layers:
        with tarfile.open(str(path)) as layer:
            times.append({entry.name: entry.mtime for entry in layer})
    assert times == [{"debian": BUILT}, {"made": 0, "package.py": BUILT - 90 * DAY}], "byte code names a source's time"


@pytest.mark.parametrize("where", ["skytether", "https://x.example/y", "x.example/Big", "x.example:99x/y", ""])
def test_what_names_no_registry(where: str) -> None:
    with pytest.raises(RegistryError, match=r"names no registry|cannot be a folder of a registry"):
        split(where)


def test_names_of_registries() -> None:
    assert split("localhost/a") == ("localhost", "a")
    assert split("[::1]:5000/a/b-c/") == ("[::1]:5000", "a/b-c")
    assert split("registry.example") == ("registry.example", "")


class Engine:
    """Has one saved image at a time."""

    def __init__(self) -> None:
        self.content = b""
        self.api = SimpleNamespace(get_image=lambda _: [self.content])


@pytest.fixture
def login(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of logins."""
    folder = tmp_path / "docker"
    folder.mkdir()
    monkeypatch.setenv("DOCKER_CONFIG", str(folder))
    return folder


@pytest.fixture(scope="module")
def server(registry_program: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A registry that everybody may push to."""
    with registry(registry_program, tmp_path_factory.mktemp("registry")) as host:
        yield host


def get(host: str, repository: str, what: str) -> Any:
    return httpx.get(f"http://{host}/v2/{repository}/{what}", headers={"Accept": INDEX}, trust_env=False).json()


def push(host: str, folder: Path, built: bytes, platform: str, *tags: str) -> Any:
    engine = Engine()
    engine.content = built
    folder.mkdir(exist_ok=True)
    with closing(Pusher(engine, f"{host}/{folder.parent.name}", folder)) as pusher:  # type: ignore[arg-type]
        pusher.check(["x"])
        made = pusher.push("x", "x:1", DEBIAN)
        pusher.attach("x", made, platform, {"bomFormat": "CycloneDX"})
        before = get(host, f"{folder.parent.name}/x", "tags/list")
        assert not tags or tags[0] not in (before["tags"] or []) or built != saved(BUILT)
        return pusher.tag("x", tags) if tags else before


@pytest.mark.slow
def test_tags_come_last_and_name_all_architectures_of_a_commit(server: str, tmp_path: Path) -> None:
    folder, name = tmp_path / "work", f"{tmp_path.name}/x"
    amd = push(server, folder, saved(BUILT), "linux/amd64", "1", "0.1.0")
    arm = push(server, folder, saved(BUILT, "arm64"), "linux/arm64", "1")
    assert list(amd.platforms) == ["linux/amd64"]
    assert list(arm.platforms) == ["linux/amd64", "linux/arm64"]
    assert arm.platforms["linux/amd64"]["digest"] == amd.platforms["linux/amd64"]["digest"]
    assert get(server, name, "manifests/0.1.0")["manifests"][0]["digest"] == amd.platforms["linux/amd64"]["digest"]
    answer = httpx.get(f"http://{server}/v2/{name}/manifests/1", headers={"Accept": INDEX}, trust_env=False)
    assert answer.headers["Docker-Content-Digest"] == arm.digest
    assert [row["platform"]["architecture"] for row in answer.json()["manifests"]] == ["amd64", "arm64"]
    # What it is made of is found from the image, and pushed twice it is there once.
    push(server, folder, saved(BUILT + DAY), "linux/amd64", "1")
    (found,) = get(server, name, f"manifests/{amd.platforms['linux/amd64']['digest'].replace(':', '-')}")["manifests"]
    assert found["artifactType"] == "application/vnd.cyclonedx+json"
    assert found["digest"] == amd.platforms["linux/amd64"]["sbom"]
    # Another commit's architectures are not kept under a tag of this one.
    other = push(server, folder, saved(BUILT, revision="beef"), "linux/amd64", "1")
    assert (list(other.platforms), other.replaced) == (["linux/amd64"], ("linux/arm64",))


@pytest.mark.slow
def test_what_was_cut_off_has_no_tag(server: str, tmp_path: Path) -> None:
    tags = push(server, tmp_path / "work", saved(BUILT), "linux/amd64")["tags"]
    assert all(tag.startswith("sha256-") for tag in tags), "the lists of packages alone"


@pytest.mark.slow
def test_who_has_no_login_is_told_before_anything_is_sent(registry_program: str, tmp_path: Path, login: Path) -> None:
    with registry(registry_program, tmp_path, passwords(tmp_path)) as host:
        with pytest.raises(RegistryError, match=f"wants a login: docker login {host}"):
            push(host, tmp_path / "work", saved(BUILT), "linux/amd64")
        log_in(login, host, "open")
        with pytest.raises(RegistryError, match=f"does not take the login kept for it.*: docker login {host}"):
            push(host, tmp_path / "work", saved(BUILT), "linux/amd64")
        assert not list((tmp_path / "store").rglob("data"))
        log_in(login, host)
        with closing(Registry(host)) as one:
            one.check("skytether/x")
            one.put_blob("skytether/x", digest_of(b"ab"), b"ab")


@pytest.mark.slow
@pytest.mark.parametrize("refresh", [False, True])
def test_a_registry_that_sends_for_tokens(registry_program: str, tmp_path: Path, login: Path, *, refresh: bool) -> None:
    with token_server(tmp_path) as auth, registry(registry_program, tmp_path, auth) as host:
        with closing(Registry(host)) as one, pytest.raises(RegistryError, match="wants a login: docker login"):
            one.check("skytether/x")
        log_in(login, host, refresh=refresh)
        with closing(Registry(host)) as one:
            one.check("skytether/x")
            one.put_blob("skytether/x", digest_of(b"ab"), b"ab")


@pytest.mark.slow
def test_what_is_wrong_with_a_registry_is_one_sentence(server: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def trouble(host: str) -> str:
        with closing(Registry(host)) as one, pytest.raises(RegistryError) as error:
            one.check("x")
        assert "\n" not in str(error.value)
        return str(error.value)

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = f"127.0.0.1:{free.getsockname()[1]}"
        assert "refused" in trouble(nobody)

    class Website(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_error(404)

        def log_message(self, *_: Any) -> None:
            pass

    website = ThreadingHTTPServer(("127.0.0.1", 0), Website)
    Thread(target=website.serve_forever, daemon=True).start()
    assert "as no registry does (status 404" in trouble(f"127.0.0.1:{website.server_address[1]}")
    website.shutdown()
    website.server_close()
    monkeypatch.setattr(image_registry, "_is_loopback", lambda _: False)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    assert "speaks plain HTTP" in trouble(server)


@pytest.mark.slow
@pytest.mark.docker
def test_a_site_that_takes_digests_only_runs_what_was_pushed(
    server: str, docker_site: DockerSite, tmp_path: Path
) -> None:
    """The smallest image, by the command."""
    command = [sys.executable, str(ROOT / "images" / "build.py"), "--prefix", docker_site.images.prefix]
    command += ["--push", f"{server}/skytether", "--json", "guard"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith("note: nothing was pushed for linux/")
    (row,) = json.loads(done.stdout)
    assert {"1", "0.1.0"} < set(row["tags"])
    (platform,) = row["platforms"].values()
    pinned = f"{row['image']}@{row['digest']}"
    try:
        with closing(docker_site.open(tmp_path, pull="missing", pinned=True)) as runtime:
            runtime.start(launch(docker_site, image=pinned))
            # nft without a script: it ran, and said so.
            assert "nft" in until_phase(runtime, Phase.EXITED).last_line
        assert docker("image", "inspect", "-f", "{{.Id}}", pinned) == platform["id"]
    finally:
        docker("image", "rm", "-f", pinned, check=False)
