"""The HTTP side: application, security, REST under ``api/`` and pages under ``pages/``."""
