"""``/tokens``: those of robots and of operators; each is shown once, when it is made."""

from __future__ import annotations

from fastapi import APIRouter, Response

from skytether.api.rest import Token, TokenCreate, TokenCreated, TokenRotate

from ...scheduling.instances import utc
from ...store.database import TokenRow
from .deps import PREFIX, Authenticated, Core, Reader, TokensOperator, made, says

router = APIRouter(prefix=f"{PREFIX}/tokens", tags=["tokens"], responses=says(401, 403, 429))


def _fields(row: TokenRow) -> dict[str, object]:
    times = {
        "created_at": utc(row.created_at),
        "expires_at": utc(row.expires_at) if row.expires_at is not None else None,
        "last_used_at": utc(row.last_used_at) if row.last_used_at is not None else None,
    }
    return {"id": row.id, "name": row.name, "robot": row.robot, "scopes": row.scopes, "family": row.family, **times}


@router.get("")
def list_tokens(core: Core, _: Reader) -> list[Token]:
    """All tokens but the one in the state folder; the oldest first."""
    return [Token.model_validate(_fields(row)) for row in core.store.tokens()]


@router.post("", status_code=201, responses=says(404, 409, 422))
def create_token(core: Core, caller: TokensOperator, asked: TokenCreate, response: Response) -> TokenCreated:
    """Make a token: another one of a robot, or an operator's with some of the scopes that the caller has."""
    row, token = core.access.create(caller, asked.name, asked.robot, asked.scopes, asked.ttl_s)
    made(response, "tokens", row.id)
    return TokenCreated.model_validate({**_fields(row), "token": token})


@router.post("/{token}/rotate", status_code=201, responses=says(404, 409, 422))
def rotate_token(core: Core, caller: Authenticated, token: str, asked: TokenRotate, response: Response) -> TokenCreated:
    """Make one with the same rights and the same end; the old one ends soon. `self` is that of the request.

    Each has one successor: another one takes its place as long as it was not used, and is refused afterwards.
    """
    row, fresh = core.access.rotate(caller, token, asked.grace_s, asked.ttl_s)
    made(response, "tokens", row.id)
    return TokenCreated.model_validate({**_fields(row), "token": fresh})


@router.delete("/{token}", status_code=204)
def delete_token(core: Core, caller: TokensOperator, token: str) -> None:
    """Revoke a token, and those that it renewed or was renewed by; may be called again."""
    core.access.forget(caller, token)
