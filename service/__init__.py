"""The running program: HTTP, jobs, commands, settings.

Why so: the packages below stay pure because everything with a life (database handle, cluster,
server, process) begins and ends here.
"""
