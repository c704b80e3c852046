"""``python -m spheremark.service.cli``: the command line without its script."""

from spheremark.service.cli.main import main

main()
