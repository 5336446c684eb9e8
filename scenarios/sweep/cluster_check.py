"""Is a Dask cluster fit for a sweep: it answers, has workers, and all of it runs our versions of everything."""

from __future__ import annotations

from typing import Any

from scenarios.sweep.program import program_facts
from sitl.errors import LinkError

CONNECT_S = 10.0
"""For a scheduler to answer."""
WORKERS_S = 10.0
"""For the first of its workers to come."""
_ENVIRONMENT = ("python", "dask", "distributed")
"""What must be alike before anything of ours can be sent at all."""


async def scheduler_answers(address: str) -> None:
    """Try an address: Dask's own client leaves threads behind where nobody answers.

    Args:
        address: of the scheduler.

    Raises:
        LinkError: nobody is there, or somebody who is no Dask scheduler.
    """
    import asyncio

    from distributed.core import rpc
    from distributed.security import Security

    remedy = "Start it, or name another: dask scheduler; or --dask local"
    try:
        security = Security().get_connection_args("client")
        async with rpc(address, timeout=CONNECT_S, connection_args=security) as scheduler:
            await asyncio.wait_for(scheduler.identity(), CONNECT_S)
    except (OSError, TimeoutError) as error:
        raise LinkError(f"{address}: no Dask scheduler answers there ({_cause(error)}). {remedy}") from None
    except Exception as error:  # what somebody else says is not for Dask's protocol to understand
        raise LinkError(f"{address}: is no Dask scheduler of our version ({_cause(error)}). {remedy}") from None


def check_workers(client: Any, address: str) -> None:
    """Wait for a worker, and compare all of them, and the scheduler, with this process.

    Args:
        client: connected. address: for people.

    Raises:
        LinkError: no workers, or one that would not give our numbers.
    """
    try:
        client.wait_for_workers(1, timeout=WORKERS_S)
    except TimeoutError:
        raise LinkError(
            f"{address}: the scheduler has had no workers for {WORKERS_S:.0f} s. Start some: dask worker {address}"
        ) from None
    found = client.get_versions(check=False)
    ours = _environment(found["client"])
    programs: dict[str, Any] = {}
    if all(_environment(one) == ours for one in (found["scheduler"], *found["workers"].values())):
        # nothing of ours may be sent to another Python
        try:
            programs["the scheduler"] = client.run_on_scheduler(program_facts)
        except Exception as error:  # whatever it lacks
            programs["the scheduler"] = error
        programs |= {f"worker {name}": it for name, it in client.run(program_facts, on_error="return").items()}
        here: Any = program_facts()
    else:
        programs["the scheduler"] = {"versions": _environment(found["scheduler"])}
        programs |= {f"worker {name}": {"versions": _environment(one)} for name, one in found["workers"].items()}
        here = {"versions": ours}
    wrong = [text for name, facts in programs.items() if (text := differs(facts, here, name))]
    if wrong:
        more = f", and {len(wrong) - 1} more differ" if len(wrong) > 1 else ""
        raise LinkError(
            f"{address}: {wrong[0]}{more}. Results would not be the same everywhere: install the same versions on "
            "the scheduler and on every worker"
        )


def differs(facts: Any, here: Any, name: str) -> str:
    """What is not alike, in a few words; empty where all is.

    Args:
        facts: of `program_facts`, there; or the error that came instead. here: ours. name: of there.
    """
    if not isinstance(facts, dict):
        return f"{name} cannot load froude ({_cause(facts)}), here is {here['versions']['froude']}"
    for what, mine in here["versions"].items():
        theirs = facts["versions"].get(what)
        if theirs != mine:
            return f"{name} has {what} {theirs}, here is {mine}"
    if facts.get("program") != here.get("program"):
        return f"{name} has other sources of froude ({facts.get('program')}), here are {here.get('program')}"
    return ""


def _environment(found: Any) -> dict[str, str]:
    packages = (found or {}).get("packages", {})
    return {name: str(packages.get(name)) for name in _ENVIRONMENT}


def _cause(error: BaseException) -> str:
    """The first line of the deepest cause of an error that says anything."""
    said, at = "", [error]
    while at:
        one = at.pop()
        said = str(one) or said
        if one.__cause__ is not None:
            at.append(one.__cause__)
    return (said or type(error).__name__).splitlines()[0]
