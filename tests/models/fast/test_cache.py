"""The cache of compiled libraries loads nothing that another could have written, and builds it again instead."""

import hashlib
import multiprocessing
import os
import shutil
import subprocess

import pytest

from latentplan.models.fast import cache
from latentplan.models.fast.cache import is_trusted, load_cached

NAME = "kernels-test.so"
COMPILER = next(filter(shutil.which, ("cc", "gcc", "clang")), None)
pytestmark = pytest.mark.skipif(COMPILER is None, reason="no C compiler")


@pytest.fixture(scope="module")
def libraries(tmp_path_factory):
    """A library whose `answer` is 42, and a hostile one that writes a file when it is loaded."""
    folder = tmp_path_factory.mktemp("built")
    trace = folder / "executed"
    sources = {
        "good.so": "int answer(void) { return 42; }",
        "bad.so": "#include <stdio.h>\n__attribute__((constructor)) static void run(void) "
        f'{{ fclose(fopen("{trace}", "w")); }}\nint answer(void) {{ return 13; }}',
    }
    for name, source in sources.items():
        (folder / "source.c").write_text(source)
        subprocess.run([COMPILER, "-shared", "-fPIC", folder / "source.c", "-o", folder / name], check=True)
    return folder


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "latentplan"


@pytest.fixture
def load(libraries, folder):
    """Loads the library through the cache and returns its answer; `load.builds` counts how often it was built."""

    def build(path):
        answer.builds += 1
        shutil.copy(libraries / "good.so", path)

    def answer():
        return load_cached(NAME, build).answer()

    answer.builds = 0
    return answer


def write_sum(library):
    library.with_name(library.name + ".sha256").write_text(hashlib.sha256(library.read_bytes()).hexdigest())


def test_library_is_built_once_into_a_private_folder(load, folder):
    assert [load(), load()] == [42, 42] and load.builds == 1
    assert folder.stat().st_mode & 0o777 == 0o700
    assert sorted(path.name for path in folder.iterdir()) == [".lock", NAME, f"{NAME}.sha256"]
    assert all(path.stat().st_mode & 0o077 == 0 for path in folder.iterdir())


def replace_by_bad(library, libraries):
    library.unlink()  # overwriting in place would change what is loaded already
    shutil.copy(libraries / "bad.so", library)


DAMAGES = {
    "another library": replace_by_bad,
    "truncated": lambda library, _: (library.rename(library.with_suffix(".old")), library.write_bytes(b"\x7fELF")),
    "empty": lambda library, _: (library.unlink(), library.touch()),
    "no checksum": lambda library, libraries: (
        replace_by_bad(library, libraries),
        library.with_name(f"{NAME}.sha256").unlink(),
    ),
    "writable by all": lambda library, libraries: (
        replace_by_bad(library, libraries),
        write_sum(library),
        library.chmod(0o666),
    ),
    "checksum writable by all": lambda library, libraries: (
        replace_by_bad(library, libraries),
        write_sum(library),
        library.with_name(f"{NAME}.sha256").chmod(0o666),
    ),
    "link": lambda library, libraries: (library.unlink(), library.symlink_to(libraries / "bad.so"), write_sum(library)),
    "folder": lambda library, _: (library.unlink(), library.mkdir()),
    "pipe": lambda library, _: (library.unlink(), os.mkfifo(library)),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_library_is_built_again_and_never_executed(damage, load, folder, libraries):
    load()
    DAMAGES[damage](folder / NAME, libraries)
    assert load() == 42 and load.builds == 2
    assert not (libraries / "executed").exists()
    assert is_trusted(folder / NAME)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file away")
@pytest.mark.parametrize("given", [NAME, f"{NAME}.sha256"])
def test_library_of_another_user_is_built_again(given, load, folder, libraries):
    load()
    replace_by_bad(folder / NAME, libraries)
    (folder / NAME).chmod(0o600)
    write_sum(folder / NAME)
    os.chown(folder / given, 12345, 12345)
    assert load() == 42 and load.builds == 2
    assert not (libraries / "executed").exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder away")
def test_folder_of_another_user_is_left_alone(load, folder, libraries):
    folder.mkdir(parents=True)
    replace = folder / NAME
    shutil.copy(libraries / "bad.so", replace)
    write_sum(replace)
    os.chown(folder, 12345, 12345)
    assert [load(), load()] == [42, 42] and load.builds == 2
    assert sorted(path.name for path in folder.iterdir()) == [NAME, f"{NAME}.sha256"]
    assert not (libraries / "executed").exists()


def test_folder_that_is_a_link_is_left_alone(load, folder, tmp_path):
    folder.parent.mkdir()
    (tmp_path / "elsewhere").mkdir()
    folder.symlink_to(tmp_path / "elsewhere")
    assert load() == 42
    assert list((tmp_path / "elsewhere").iterdir()) == []


def test_folder_that_others_can_enter_is_closed(load, folder):
    folder.mkdir(parents=True)
    folder.chmod(0o777)
    assert load() == 42
    assert folder.stat().st_mode & 0o777 == 0o700


def test_build_that_fails_leaves_the_cache_as_it_was(load, folder):
    load()

    def fail(path):
        path.write_bytes(b"half")
        raise OSError("no space left")

    with pytest.raises(OSError, match="no space"):
        load_cached("kernels-other.so", fail)
    assert sorted(path.name for path in folder.iterdir()) == [".lock", NAME, f"{NAME}.sha256"]


def test_library_that_cannot_be_loaded_is_built_again(load, folder):
    folder.mkdir(parents=True)
    (folder / NAME).write_bytes(b"made for another system")
    (folder / NAME).chmod(0o600)
    write_sum(folder / NAME)
    (folder / f"{NAME}.sha256").chmod(0o600)
    assert is_trusted(folder / NAME)
    assert load() == 42 and load.builds == 1


def _load_in_process(libraries, results):
    results.put(load_cached(NAME, lambda path: shutil.copy(libraries / "good.so", path)).answer())


def test_processes_that_build_at_once_all_load(libraries, folder):
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    processes = [context.Process(target=_load_in_process, args=(libraries, results)) for _ in range(4)]
    for process in processes:
        process.start()
    assert [results.get(timeout=30) for _ in processes] == [42] * 4
    for process in processes:
        process.join()
    assert cache.is_trusted(folder / NAME)
