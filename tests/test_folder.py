import pytest
from gltf_files import FACES, JOINTS, VERTICES, WEIGHTS

from skinlib.datasets.folder import load_folder
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import write_head

SKELETON = Skeleton.from_heads_and_tails(JOINTS, None, [-1, 0, 1], ["a", "b", "c"])
HEAD = Head.create(VERTICES, FACES, SKELETON, WEIGHTS)


def test_heads_come_sorted_and_named_after_their_files(tmp_path):
    for name in ("b.npz", "a.glb", "C.npz", ".hidden.npz"):
        write_head(tmp_path / name, HEAD)
    (tmp_path / "readme.txt").touch()
    (tmp_path / "old.glb").mkdir()
    assert [head.name for head in load_folder(tmp_path)] == ["C", "a", "b"]


def test_folder_without_heads(tmp_path):
    (tmp_path / "readme.txt").touch()
    for folder, words in {
        tmp_path: "there is no .npz or .glb file in it",
        tmp_path / "readme.txt": "it is a file",
        tmp_path / "none": "there is no such folder",
    }.items():
        with pytest.raises(HeadError, match=f"folder: {words}") as error:
            load_folder(folder)
        assert error.value.file == str(folder)


def test_two_files_of_one_stem(tmp_path):
    for name in ("a.npz", "a.glb"):
        write_head(tmp_path / name, HEAD)
    with pytest.raises(HeadError, match=r"a\.glb and a\.npz have the same stem"):
        load_folder(tmp_path)


def test_a_bad_file_is_named(tmp_path):
    write_head(tmp_path / "good.npz", HEAD)
    (tmp_path / "worse.npz").write_bytes(b"PK")
    with pytest.raises(HeadError, match=r"worse\.npz"):
        load_folder(tmp_path)
