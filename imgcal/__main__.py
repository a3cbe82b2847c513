"""`python -m imgcal` is the command `imgcal`."""

from imgcal.cli.main import run

run()
