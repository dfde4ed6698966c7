"""A provider of Terraform that knows the types of its resources, and nothing else: for tests without the real one.

    schema_provider.py FILE    # as Terraform starts it; FILE is one of tests/terraform/schemas

Terraform checks a configuration against the schema that its provider states, and `mock_provider` makes up the rest.
This program states the schema that was read out of the provider's bindings (`.ci/provider_schemas.py`) in Terraform's
plug-in protocol 5, and finds fault with nothing. Messages are few and flat, so they are written here, without a
compiler of protocol buffers.
"""

from __future__ import annotations

import base64
import json
import os
import re
import sys
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import grpc
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

Schema = dict[str, Any]
LIST, SET = 2, 3
"""Kinds of nested blocks."""


def varint(value: int) -> bytes:
    """As protocol buffers write a number."""
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def field(number: int, value: str | bytes | int) -> bytes:
    """One field of a message; a message within is bytes."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    data = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(data)) + data


def ctype(name: str) -> str:
    """A type as JSON of Terraform's type system: ``list(string)`` is ``["list","string"]``."""
    inner = re.fullmatch(r"(list|map)\((.*)\)", name)
    if inner:
        return f'["{inner[1]}",{ctype(inner[2])}]'
    return f'"{ {"boolean": "bool", "any": "dynamic"}.get(name, name) }"'


def block(body: Schema) -> bytes:
    """A block with its attributes. What need not be given may be computed: which is, the bindings do not say."""
    message = b""
    for name, type_ in body["attributes"].items():
        required = type_.endswith("!")
        said = field(1, name) + field(2, ctype(type_.removesuffix("!")))
        said += field(4, 1) if required else field(5, 1) + field(6, 1)
        message += field(2, said)
    for name, type_ in body.get("computed", {}).items():
        message += field(2, field(1, name) + field(2, ctype(type_)) + field(6, 1))
    for name, inner in body["blocks"].items():
        said = field(1, name) + field(2, block(inner)) + field(3, LIST)
        said += (field(4, 1) if inner["required"] else b"") + (b"" if inner["several"] else field(5, 1))
        message += field(3, said)
    return message


def schema(body: Schema) -> bytes:
    """A schema of version 0."""
    return field(2, block(body))


def answer(found: Schema) -> bytes:
    """All schemas, as `GetSchema` answers."""
    message = field(1, schema(found["provider"]))
    for number, kind in ((2, "resource"), (3, "data")):
        for name, body in found[kind].items():
            message += field(number, field(1, name) + field(2, schema(body)))
    return message


class Provider(grpc.GenericRpcHandler):
    """States the schema; finds no fault in a configuration. All else is made up before it is asked."""

    def __init__(self, found: Schema) -> None:
        self._schema = answer(found)

    def service(self, details: grpc.HandlerCallDetails) -> grpc.RpcMethodHandler | None:
        method = details.method.rpartition("/")[2]
        answers = {"GetSchema": self._schema}
        answers |= dict.fromkeys(("ValidateResourceTypeConfig", "ValidateDataSourceConfig", "Configure", "Stop"), b"")
        if method == "Shutdown":  # of go-plugin, which otherwise waits for two seconds
            os._exit(0)
        if method == "PrepareProviderConfig":  # gives back what it was given
            return grpc.unary_unary_rpc_method_handler(lambda request, _: request)
        if method in answers:
            return grpc.unary_unary_rpc_method_handler(lambda request, _: answers[method])
        return None


def certificate() -> tuple[bytes, bytes, bytes]:
    """Key and certificate as PEM, and the certificate as DER: Terraform and its plug-ins know each other by these."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(minutes=1))
        .not_valid_after(now + timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, SHA256())
    )
    pem = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    return pem, made.public_bytes(Encoding.PEM), made.public_bytes(Encoding.DER)


def main(path: str) -> None:
    """Serve until Terraform ends us."""
    with open(path) as file:
        found = json.load(file)
    server = grpc.server(ThreadPoolExecutor(4), options=[("grpc.so_reuseport", 0)])
    server.add_generic_rpc_handlers((Provider(found),))
    key, pem, der = certificate()
    # Whoever comes may know the schema: gRPC's library takes no certificates of the kind that Terraform shows.
    port = server.add_secure_port("127.0.0.1:0", grpc.ssl_server_credentials([(key, pem)]))
    server.start()
    there = base64.b64encode(der).rstrip(b"=").decode()
    sys.stdout.write(f"1|5|tcp|127.0.0.1:{port}|grpc|{there}\n")
    sys.stdout.flush()
    server.wait_for_termination()


if __name__ == "__main__":
    main(sys.argv[1])
