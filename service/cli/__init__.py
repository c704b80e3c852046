"""The command ``spheremark``: one module for each group of commands."""
