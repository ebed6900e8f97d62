"""`python -m jaxba`: the command line."""

from jaxba.cli import main

if __name__ == "__main__":
    main()
