"""`latentplan pull`: download an agent from the model hub, and check it before it gets its place."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from latentplan.commands.shell import HubRequest
from latentplan.config.parsing import option


@dataclass(frozen=True, kw_only=True)
class Request(HubRequest):
    """The command line of a download.

    Attributes:
        out: Folder of the agent; it must not exist, or be empty.
        revision: Branch, tag or commit; None takes the main branch.
    """

    NOTES = "Needs the extra latentplan[hub]. Nothing of the repository is executed."

    out: Path = option(metavar="DIR")
    revision: str | None = None


def run(request: Request) -> int:
    """Download the agent, print the commit that it is from, and return the exit code.

    Raises:
        UserError: There is no such agent, it cannot be used, or the folder is not free.
    """
    from latentplan.config.extras import require_extra

    require_extra("this command", "huggingface_hub")
    from latentplan.agents.hub import pull_agent

    commit = pull_agent(request.repo, request.out, revision=request.revision, endpoint=request.endpoint)
    print(f"{request.out}: the agent of {request.repo} at commit {commit}")
    return 0
