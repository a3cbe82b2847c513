"""Run the `imgcal` command as `python -m imgcal`."""

from imgcal.cli.interruption import end_at_once


def run() -> None:
    """Entry point of the installed command."""
    with end_at_once():
        from imgcal.cli.main import run as run_command
    run_command()


if __name__ == "__main__":
    run()
