"""Command ``armident keys``: options and output; the work is imported when it runs."""

import json
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from armident.daq.identity.plant import Finding


def keys(
    action: Annotated[str, typer.Argument(help="init, enrol, show, check, renew, revoke or router.")],
    subject: Annotated[
        str | None,
        typer.Argument(help="enrol: capture, worker, operator, viewer, router or opcua. renew, revoke: a name."),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder", file_okay=False, help="Folder of keys. [default: ARMIDENT_KEYS or /etc/armident/keys]"
        ),
    ] = None,
    plant: Annotated[str, typer.Option("--plant", help="init: name of the plant.")] = "plant",
    cell: Annotated[
        str | None, typer.Option("--cell", help="enrol: cell. [default of operator and viewer: all cells]")
    ] = None,
    name: Annotated[str | None, typer.Option("--name", help="enrol: person or host. [default: the cell]")] = None,
    address: Annotated[
        list[str] | None,
        typer.Option(
            "--address", help="enrol, renew: DNS name, IP address, or urn: of an OPC UA application; can be repeated."
        ),
    ] = None,
    days: Annotated[int, typer.Option("--days", min=1, max=3650, help="enrol, renew: validity, days.")] = 365,
    every: Annotated[bool, typer.Option("--all", help="renew: all names.")] = False,
    within: Annotated[
        int | None, typer.Option("--within", min=0, help="With --all: those that end within this time, days.")
    ] = None,
    config: Annotated[str | None, typer.Option("--config", help="check: session that uses the keys.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="show, check: print JSON.")] = False,
) -> None:
    """Make and check the keys of a plant: its authority, and a certificate for each role of a cell or person.

    init makes the authority. enrol makes the certificate of a role; renew makes a new one and revoke removes one. Each
    of them writes router.json5, the access control of the router for exactly the enrolled names; router does only that.

    show lists the certificates. check names everything that would fail later, and says who may do what. Exit code 1 if
    something fails.

    Example: armident keys enrol viewer --name anna --cell press_7
    """
    from armident.configs import ArmidentError, ConfigError, load_session
    from armident.daq.identity import OF_PLANT, VARIABLE
    from armident.daq.identity import plant as of_plant
    from armident.daq.identity.access import ROUTER_FILE
    from armident.daq.identity.certificates import REVOKED
    from armident.daq.identity.folder import key_folder

    addresses, now = address or [], datetime.now(UTC)
    if action == "init":
        path = folder or Path(os.environ.get(VARIABLE) or OF_PLANT)
        of_plant.make_authority(path, plant)
        print(f"{path}: authority of {plant}, valid for {of_plant.AUTHORITY_DAYS // 365} years")
        print(f"{path / 'authority.key'} signs every certificate: keep it, and a copy, offline and on no cell")
        return
    found = key_folder(folder)
    if found.local:
        raise ConfigError(f"{OF_PLANT}: no such folder; run armident keys init, or name the folder with --folder")
    path = found.path
    if subject is None and (action in ("enrol", "revoke") or (action == "renew" and not every)):
        what = "role: capture, worker, operator, viewer, router or opcua" if action == "enrol" else "name, or --all"
        raise ConfigError(f"armident keys {action}: expected a {what}")
    made = []
    if action == "enrol":
        made.append(of_plant.enrol(path, str(subject), cell, name, addresses, days))
    elif action == "renew" and every:
        ending = [
            each
            for each in of_plant.enrolled(path)
            if within is None or of_plant.days_left(each.certificate, now) <= within
        ]
        made += [of_plant.renew(path, each.name, (), days) for each in ending]
        print(f"{len(made)} of {len(of_plant.enrolled(path))} certificates renewed")
    elif action == "renew" and subject == of_plant.AUTHORITY:
        of_plant.renew_authority(path)
        print(f"{path / 'authority.pem'}: new authority; the former ones stay trusted until they end")
        print(f"first copy it and {REVOKED} to all hosts and restart the router, then: armident keys renew --all")
    elif action == "renew":
        made.append(of_plant.renew(path, str(subject), addresses, days))
    elif action == "revoke":
        of_plant.revoke(path, str(subject))
        print(f"{subject}: revoked once the router has started again with {path / ROUTER_FILE},")
        print(f"  and elsewhere once {path / REVOKED} is in the folder of keys of the host")
    elif action == "router":
        of_plant.write_router(path)
        print(path / ROUTER_FILE)
    elif action == "show":
        _show([each.row(now) for each in of_plant.enrolled(path)], as_json=as_json)
    elif action == "check":
        session = None if config is None else load_session(config, "")
        results = list(of_plant.findings(path, now, session))
        results += [] if session is None else of_plant.missing(path, session)
        _print_check(results, of_plant.explanations(path), as_json=as_json)
        if any(each.verdict == "failed" for each in results):
            raise ArmidentError(f"{path}: connections fail, or will soon")
    else:
        raise ConfigError(f"no action {action!r}; expected init, enrol, show, check, renew, revoke or router")
    for each in made:
        files = f"{path}/{each.name}.pem, {each.name}.key, authority.pem and {REVOKED}"
        print(f"{each.name}: valid until {each.certificate.not_valid_after_utc:%Y-%m-%d}")
        print(f"  copy {files} to {OF_PLANT} on its host")
    if action == "enrol":
        print(f"copy {path / ROUTER_FILE} to the host of the router, and restart the router")
    elif any(each.name.startswith("router.") for each in made):
        print("restart the router then: it reads its certificate at its start")


def _show(rows: list[dict[str, Any]], *, as_json: bool) -> None:
    if as_json:
        print(json.dumps(rows))
        return
    lines = [["name", "role", "cell", "valid until", "days", "addresses"]]
    lines += [[*map(str, list(row.values())[:-1]), ", ".join(row["addresses"])] for row in rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    for line in lines:
        print("  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip())


def _print_check(results: "Sequence[Finding]", explanations: Sequence[str], *, as_json: bool) -> None:
    if as_json:
        found = [{"verdict": each.verdict, "found": each.message} for each in results]
        print(json.dumps({"checks": found, "permissions": explanations}))
        return
    for each in results:
        print(f"{each.verdict:8} {each.message}")
    print(*explanations, sep="\n")
