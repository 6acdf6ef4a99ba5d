"""The command line: `lodbench COMMAND ...`."""

from lodbench.cli.shell import main as main
