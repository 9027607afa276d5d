"""Machinery beside the values of core: processes, threads, isolated readers, atomic writes, compiled loops."""
