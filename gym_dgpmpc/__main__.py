"""`python -m gym_dgpmpc` is the command `dgpmpc`."""

from gym_dgpmpc.cli import app

if __name__ == "__main__":
    app(prog_name="dgpmpc")
