"""The documentation: links lead somewhere, and code blocks compile and run."""

import ast
import functools
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
FENCE = re.compile(r"^(`{3,}|:{3,}).*?^\1$", flags=re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)\s]+)(?:\s[^)]*)?\)")
BUILT = re.compile(r"docs/_build/|build/docs/")  # what `make docs` writes
PLAYING = {"docs/get-started.md", "docs/guides/new-goals.md"}  # load a shipped agent and ask it once
TRAINING = {"docs/guides/own-environment.md", "docs/guides/resume.md", "docs/guides/distillation.md"}  # only define


def page_name(page):
    return page.relative_to(ROOT).as_posix()


def prose(page):
    """The text of a page without its fenced blocks."""
    return FENCE.sub("", page.read_text())


@functools.cache
def anchors(page):
    """The anchors of a page's headings, as GitHub and MyST name them."""
    headings = re.findall(r"^#+ (.*)", prose(page), flags=re.MULTILINE)
    texts = (re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in texts}


def python_blocks(page):
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), flags=re.DOTALL | re.MULTILINE)


WITH_CODE = [page for page in PAGES if python_blocks(page)]


def test_pages_are_found():
    names = {page_name(page) for page in PAGES}
    assert {"README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/index.md", "docs/lab/index.md"} <= names


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_lead_to_pages_and_headings(page):
    for link in LINK.findall(prose(page)):
        if re.match(r"https?://", link) or BUILT.search(link):
            continue
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", [page for page in PAGES if page.is_relative_to(ROOT / "docs")], ids=page_name)
def test_pages_of_the_site_stay_within_docs(page):
    for link in LINK.findall(prose(page)):
        if not re.match(r"https?://|#", link):
            assert (page.parent / link.partition("#")[0]).resolve().is_relative_to(ROOT / "docs"), link


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_no_line_is_a_comment_that_is_not_shown(page):
    """MyST leaves out a line that begins with a percent sign, such as the second line of a paragraph with "95 %"."""
    assert re.findall(r"^\s*%.*", prose(page), flags=re.MULTILINE) == []


def test_glossary_defines_every_term():
    entries = prose(ROOT / "docs/reference/glossary.md").strip().split("\n\n")[1:]
    assert [entry for entry in entries if not re.match(r"[^\n]+\n: ", entry)] == []


def test_every_picture_is_shown_on_a_page():
    shown = {
        (page.parent / link).resolve() for page in PAGES for link in re.findall(r"!\[[^\]]*\]\(([^)\s]+)", prose(page))
    }
    pictures = [path for kind in ("png", "gif", "webp") for path in (ROOT / "docs").rglob(f"*.{kind}")]
    assert not [path for path in pictures if path.resolve() not in shown]


@pytest.mark.parametrize("page", WITH_CODE, ids=page_name)
def test_python_blocks_compile(page):
    for number, block in enumerate(python_blocks(page)):
        ast.parse(block, f"{page_name(page)}, block {number}")


@pytest.mark.parametrize("page", [page for page in WITH_CODE if page_name(page) in PLAYING | TRAINING], ids=page_name)
def test_python_blocks_run(page, monkeypatch):
    monkeypatch.chdir(ROOT)
    for number, block in enumerate(python_blocks(page)):
        exec(compile(block, f"{page_name(page)}, block {number}", "exec"), {"__name__": "example"})


def test_environment_of_the_guide_can_be_wrapped():
    from latentplan.envs import wrap_user_env

    namespace = {"__name__": "example"}
    exec(python_blocks(ROOT / "docs" / "guides" / "own-environment.md")[0], namespace)
    env = wrap_user_env(namespace["make_env"](), action_repeat=2)
    frame, _ = env.reset(seed=0)
    assert frame.shape == (64, 64, 3)
    _, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert 0.0 <= reward <= 2.0 and not terminated and not truncated and info["env_frames"] == 2


def test_lab_notebook_lists_every_experiment():
    folder = ROOT / "docs" / "lab"
    listed = set(re.findall(r"\]\((\w[\w-]*\.md)\)", (folder / "index.md").read_text()))
    assert listed == {path.name for path in folder.glob("*.md")} - {"index.md"}
