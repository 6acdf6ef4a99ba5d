"""The LaTeX tables: as many cells in every row, balanced; compiled where a LaTeX is installed."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2] / "leaderboard"
FILES = sorted(ROOT.glob("*.tex"))


def tables(path: Path) -> list[str]:
    return re.findall(r"\\begin\{tabular\}.*?\\end\{tabular\}", path.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_row_has_as_many_cells_as_columns(path):
    assert tables(path)
    for table in tables(path):
        width = len(re.match(r"\\begin\{tabular\}\{([lc]+)\}", table)[1])
        assert table.count("{") == table.count("}")
        for line in table.splitlines():
            if "&" in line:
                spanned = sum(int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", line))
                assert line.count("&") + 1 + spanned == width, line
        for start, rows in enumerate(table.split(r"\midrule")):
            for count in map(int, re.findall(r"\\multirow\{(\d+)\}", rows)):
                assert rows.count(r"\\" + "\n") == count, start


def test_they_compile(tmp_path):
    latex, finder = shutil.which("pdflatex"), shutil.which("kpsewhich")
    packages = ("booktabs", "multirow", "makecell")
    if latex is None or finder is None:
        pytest.skip("there is no LaTeX on this machine (apt-get install texlive-latex-extra)")
    names = [f"{package}.sty" for package in packages]
    if len(subprocess.run([finder, *names], capture_output=True, text=True).stdout.split()) < len(names):
        pytest.skip("LaTeX is here without booktabs, multirow and makecell")
    body = "\n\n".join(table for path in FILES for table in tables(path))
    head = r"\documentclass{article}\usepackage[landscape,margin=5mm]{geometry}"
    uses = rf"\usepackage{{{','.join(packages)}}}"
    (tmp_path / "all.tex").write_text(
        f"{head}{uses}\\begin{{document}}\\scriptsize\n{body}\n\\end{{document}}\n"
    )
    words = [latex, "-halt-on-error", "-interaction=nonstopmode", "all.tex"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-1500:]
    assert "Overfull" not in done.stdout
