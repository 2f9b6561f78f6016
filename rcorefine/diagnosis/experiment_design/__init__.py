"""Experiment design: measurements that distinguish the candidates.

The present record cannot distinguish them.
"""
