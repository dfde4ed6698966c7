"""Sites and groups that a file declares: what ``sites_file`` names, as a chart or a configuration tool writes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skytether.api.groups import GroupCreate
from skytether.api.rest import SiteCreate
from skytether.api.validation_errors import Fault
from skytether.api.yaml import YamlError, read_yaml

from ..domain.errors import InvalidError
from ..domain.validation import parse
from ..runtimes.base import Runtime

_GROUP = "provider"
"""The key that a group has, and no site."""


def read_sites(path: Path) -> list[SiteCreate]:
    """The sites of a YAML file: one document, by name what is given of each.

    Raises:
        InvalidError: It cannot be read, or a key is wrong; the text begins with the path.
    """
    return [
        parse(SiteCreate, {"name": name, **given}, str(path), (name,))
        for name, given in _entries(path)
        if _GROUP not in given
    ]


def read_groups(path: Path) -> list[GroupCreate]:
    """The groups of sites of the same file: those with a ``provider``.

    Raises:
        InvalidError: It cannot be read, or a key is wrong; the text begins with the path.
    """
    return [
        parse(GroupCreate, {"name": name, **given}, str(path), (name,))
        for name, given in _entries(path)
        if _GROUP in given
    ]


def _entries(path: Path) -> list[tuple[str, dict[str, Any]]]:
    try:
        documents = read_yaml(path)
    except YamlError as error:
        raise InvalidError([Fault("", str(error))]) from None
    document = documents[0] if documents else {}
    if len(documents) > 1 or not isinstance(document, dict):
        raise InvalidError([Fault("", "must hold one document: the sites by their names")], str(path))
    for name, given in document.items():
        if not isinstance(given, dict):
            raise InvalidError(
                [Fault(str(name), "must be what is known of the site: tier, runtime, options")], str(path)
            )
        if _GROUP in given and "runtime" in given:
            text = "a site has a runtime, a group of sites a provider: leave one of them out"
            raise InvalidError([Fault(str(name), text)], str(path))
    return [(str(name), given) for name, given in document.items()]


def stored_as(asked: SiteCreate, there: SiteCreate | None, kind: type[Runtime]) -> SiteCreate:
    """How a declared site is to be stored; ``there``: as it is stored now.

    Raises:
        InvalidError: Its options are wrong, or what it is to become would lose what runs there.
    """
    where = (asked.name, "options")
    parse(kind.Options, asked.options, prefix=where)
    if there is None:
        return asked.model_copy(update={"options": kind.completed(asked.options)})
    if there.runtime != asked.runtime:
        text = f"the site runs on '{there.runtime}' and holds what was started there: delete it first, or name another"
        raise InvalidError([Fault(f"{asked.name}.runtime", text)])
    made_up = kind.completed(asked.options).keys() - asked.options.keys()
    options: dict[str, Any] = {key: there.options[key] for key in made_up & there.options.keys()} | asked.options
    if kind.unique and options.get(kind.unique) != there.options.get(kind.unique):
        text = (
            f"is '{there.options.get(kind.unique)}' since the site was made, and by it what runs there is found again"
        )
        raise InvalidError([Fault(f"{asked.name}.options.{kind.unique}", text)])
    return asked.model_copy(update={"options": options})
