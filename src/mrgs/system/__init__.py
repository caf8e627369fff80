"""Devices, atomic files, child processes, and the security policy of web pages."""
