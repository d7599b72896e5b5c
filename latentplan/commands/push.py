"""`latentplan push`: upload an agent and its card to the model hub."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from latentplan.commands.shell import HubRequest
from latentplan.config import UserError
from latentplan.config.parsing import option
from latentplan.config.reading import LARGEST_SETTINGS, read_text


@dataclass(frozen=True, kw_only=True)
class Request(HubRequest):
    """The command line of an upload.

    Attributes:
        checkpoint: Folder of a trained agent, or of a run (its best checkpoint).
        private: Whether only you can see the repository; one that exists must be private already.
    """

    NOTES = "Needs the extra latentplan[hub]. `hf auth login` names you to the hub."

    checkpoint: Path = option(metavar="DIR")
    private: bool = False


def run(request: Request) -> int:
    """Upload the agent, print the address of the commit, and return the exit code.

    Raises:
        UserError: The agent or its card cannot be used, or the hub refuses the upload.
    """
    from latentplan.agents.info import read_info, resolve_checkpoint
    from latentplan.config.extras import require_extra

    require_extra("this command", "huggingface_hub")
    folder = resolve_checkpoint(request.checkpoint)
    read_info(folder)  # refuses a damaged agent before torch is imported
    _require_fresh_card(folder)
    from latentplan.agents.hub import push_agent

    print(push_agent(folder, request.repo, private=request.private, endpoint=request.endpoint))
    return 0


def _require_fresh_card(folder: Path) -> None:
    """Refuses a card that was written for an earlier agent of the folder; one without a seal is the user's own.

    Raises:
        UserError: The card has to be written again.
    """
    import hashlib

    from latentplan.agents.files import CARD, INFO, read_files
    from latentplan.reporting.card import read_seal

    if not (folder / CARD).exists():
        return  # `push_agent` says what is missing
    seal = read_seal(read_text(folder / CARD, LARGEST_SETTINGS))
    if seal is not None and seal.info_sha256 != hashlib.sha256(read_files(folder, (INFO,))[INFO]).hexdigest():
        raise UserError(
            f"{folder / CARD} describes an earlier agent of this folder: write it again with "
            f"`latentplan card --checkpoint {folder}`"
        )
