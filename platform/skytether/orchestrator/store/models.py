"""Tables. A change here needs a migration in ``migrations/versions``; a test compares the two."""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    BigInteger,
    Boolean,
    Column,
    Enum,
    Float,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Table,
    Text,
    false,
)

from skytether.api.rest import State

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s",
        "pk": "pk_%(table_name)s",
    }
)

services = Table(
    "services",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("manifest", JSON, nullable=False),
    comment="Manifests that were PUT; built-in ones and those of a folder are not here",
)

sites = Table(
    "sites",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("tier", String(16), nullable=False),
    Column("runtime", String(63), nullable=False),
    Column("options", JSON, nullable=False),
    Column("speed", Float, nullable=False, server_default="1"),
    Column("cost", Float, nullable=False, server_default="0"),
    Column("images", JSON, nullable=False, server_default='["*"]'),
    Column("draining", Boolean, nullable=False, server_default=false()),
    Column("evacuating", Boolean, nullable=False, server_default=false(), comment="What runs there is moved elsewhere"),
)

nodes = Table(
    "nodes",
    metadata,
    Column("site", String(63), ForeignKey("sites.name", ondelete="CASCADE"), primary_key=True),
    Column("serial", String(40), nullable=False, comment="Of the certificate that it showed last"),
    Column("ends_at", Float, nullable=False),
    Column("next_serial", String(40), comment="Of the one that it was given and has not shown yet"),
    Column("follow", Boolean, nullable=False, comment="Whether the address of the site is the machine's present one"),
    Column("joined_at", Float, nullable=False),
    Column("seen_at", Float, nullable=False),
    Column("seen_as", String(64), nullable=False, comment="Address that its connections come from"),
    Column("machine", JSON, nullable=False),
    comment="Machines that joined, and which certificates of theirs are good: no others are",
)

invitations = Table(
    "invitations",
    metadata,
    Column("id", String(16), primary_key=True),
    Column("prefix", String(16), nullable=False, index=True),
    Column("sha256", String(64), nullable=False),
    Column("site", JSON, nullable=False, comment="As it is to be"),
    Column("name", String(63), nullable=False),
    Column("by", String(80), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float, nullable=False),
    Column("used_at", Float, comment="NULL: it is good"),
    Column("used_from", String(64)),
    Column("used_key", String(64), comment="SHA-256 of the public key that got a certificate"),
    comment="Tokens with which a machine may join, once",
)

site_groups = Table(
    "site_groups",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("asked", JSON, nullable=False),
    Column("owner", String(32), nullable=False, comment="Word by which its machines are found again"),
    Column("draining", Boolean, nullable=False, server_default=false()),
    Column("failures", Integer, nullable=False, server_default="0"),
    Column("retry_at", Float, nullable=False, server_default="0"),
    Column("reason", String(1024), nullable=False, server_default=""),
    Column("told", JSON, nullable=False, server_default="[]", comment="The last events, oldest first"),
    comment="Groups of sites, whose machines are made and destroyed as they are needed",
)

machines = Table(
    "machines",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("site_group", String(63), ForeignKey("site_groups.name"), nullable=False, index=True),
    Column("stage", String(16), nullable=False),
    Column("since", Float, nullable=False, comment="Of the stage"),
    Column("provided", String(255), comment="The provider's id; NULL: it has not said yet"),
    Column("reason", String(1024), nullable=False, server_default=""),
    comment="A row is there before its machine is made, and until that is destroyed",
)

robots = Table(
    "robots",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("services", JSON, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("last_seen_at", Float),
    Column("share_group", String(63), comment="With whom it shares what it sees; NULL: with nobody"),
)

shared = Table(
    "shared",
    metadata,
    Column("robot", String(63), ForeignKey("robots.name", ondelete="CASCADE"), primary_key=True),
    Column("service", String(63), primary_key=True),
    Column("share_group", String(63), nullable=False, comment="To which it was told"),
    Column("at", Float, nullable=False),
    Column("text", Text, nullable=False),
    comment="What each robot's services told the others of its group last",
)

stops = Table(
    "stops",
    metadata,
    Column("robot", String(63), ForeignKey("robots.name", ondelete="CASCADE"), primary_key=True),
    Column("id", String(32), nullable=False),
    Column("at", Float, nullable=False),
    Column("reason", String(200), nullable=False),
    Column("by", String(80), nullable=False),
    Column("acknowledged_at", Float),
    comment="The last order to each robot to stop",
)

gates = Table(
    "gates",
    metadata,
    Column("robot", String(63), ForeignKey("robots.name", ondelete="CASCADE"), primary_key=True),
    Column("at", Float, nullable=False),
    Column("report", JSON, nullable=False),
    comment="What each robot said last of the gate before its wheels",
)

tokens = Table(
    "tokens",
    metadata,
    Column("id", String(16), primary_key=True),
    Column("name", String(63), nullable=False),
    Column("robot", String(63), ForeignKey("robots.name", ondelete="CASCADE"), comment="NULL: an operator's"),
    Column("scopes", JSON, nullable=False),
    Column("prefix", String(16), nullable=False, index=True),
    Column("sha256", String(64), nullable=False),
    Column("created_at", Float, nullable=False),
    Column("expires_at", Float),
    Column("last_used_at", Float),
    Column("family", String(16), nullable=False, server_default="", index=True),
    Column("ends_at", Float, comment="NULL: never"),
    Column("successor", String(16), comment="NULL: it was not renewed"),
    Column("handle", String(127), comment="Robot and name, of one token at a time; NULL: it was renewed"),
    Index(None, "handle", unique=True),
)

instances = Table(
    "instances",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("robot", String(63), nullable=False, index=True),
    Column("service", String(63), nullable=False),
    Column("session_id", String(16), nullable=False, unique=True),
    Column("manifest", JSON, nullable=False),
    Column("created_at", Float, nullable=False),
    Column("lease_s", Float, nullable=False),
    Column("lease_expires_at", Float, nullable=False),
    Column("updated_at", Float, nullable=False),
    Column("params", JSON, nullable=False),
    Column("measurements", JSON, nullable=False),
    Column(
        "state",
        Enum(
            State, native_enum=False, create_constraint=False, length=16, values_callable=lambda s: [m.value for m in s]
        ),
        nullable=False,
        index=True,
    ),
    Column("reason", String(1024), nullable=False),
    Column("pull", JSON(none_as_null=True), comment="How far that is; NULL: the reason tells of no pull"),
    Column("site", String(63)),
    Column("refused", JSON, nullable=False),
    Column("scores", JSON, nullable=False, server_default="[]"),
    Column("host", String(255)),
    Column("port", Integer),
    Column("attempt", Integer, nullable=False),
    Column("failures", Integer, nullable=False),
    Column("restarts", Integer, nullable=False),
    Column("start_at", Float, nullable=False),
    Column("started_at", Float),
    Column("running_at", Float),
    Column("stopping_at", Float),
    Column("replaces", String(32), index=True),
    Column("pinned", String(63)),
    # The column keeps the name that it was made with: orchestrators of the version before may run still.
    Column("spare", Boolean, key="standby", nullable=False, server_default=false()),
    Column("claim", String(64), comment="SHA-256 of the claim that got the session's key; NULL: nobody did"),
    Column("key_id", String(32), nullable=False, server_default=""),
    Column("size", JSON(none_as_null=True), comment="What it has; NULL: what its manifest says"),
    Column("resize", JSON(none_as_null=True), comment="What it is to have instead; NULL: nothing else"),
    Column("said", Integer, nullable=False, server_default="0", comment="See Record.said"),
    Column("version", Integer, nullable=False),
)

events = Table(
    "events",
    metadata,
    Column("id", BigInteger().with_variant(Integer, "sqlite"), primary_key=True, autoincrement=True),
    Column("instance", String(32), ForeignKey("instances.id", ondelete="CASCADE"), nullable=False),
    Column("at", Float, nullable=False),
    Column("state", String(16), nullable=False),
    Column("reason", String(1024), nullable=False),
    Column("code", String(63), nullable=False, server_default="", comment="Of what the service said; empty: our own"),
    Column("pull", JSON(none_as_null=True), comment="How far that is; NULL: the reason tells of no pull"),
    Index(None, "instance", "id"),
    sqlite_autoincrement=True,  # an id that a watcher has seen must not come again after pruning
)

idempotency = Table(
    "idempotency",
    metadata,
    Column("owner", String(80), primary_key=True, comment="Whose key it is: two tokens may use the same one"),
    Column("key", String(255), primary_key=True),
    Column("body_sha256", String(64), nullable=False),
    Column("instance", String(32), ForeignKey("instances.id", ondelete="CASCADE"), nullable=False),
    Column("created_at", Float, nullable=False),
)

reports = Table(
    "reports",
    metadata,
    Column("instance", String(32), ForeignKey("instances.id", ondelete="CASCADE"), primary_key=True),
    Column("at", Float, nullable=False),
    Column("report", JSON, nullable=False),
    comment="The last of each instance's robot: any orchestrator may get it, and the one that leads exports it",
)

accounts = Table(
    "accounts",
    metadata,
    Column("robot", String(63), primary_key=True),
    Column("service", String(63), primary_key=True),
    Column("account", JSON, nullable=False),
    comment="Counters of each robot and service, over all programs and runs that counted them",
)

orchestrators = Table(
    "orchestrators",
    metadata,
    Column("address", String(300), primary_key=True),
    Column("seen_at", Float, nullable=False),
)

facts = Table(
    "facts",
    metadata,
    Column("name", String(63), primary_key=True),
    Column("value", String(255), nullable=False),
    comment="What all orchestrators over this database must agree on",
)

leadership = Table(
    "leadership",
    metadata,
    Column("one", Boolean, primary_key=True),
    Column("epoch", BigInteger, nullable=False),
    Column("holder", String(16), nullable=False),
    Column("until", Float, nullable=False),
    comment="One row: who leads, until when by the database's clock, and whose leader may still change something",
)
