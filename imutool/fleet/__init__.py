"""Fleet: one command on many logs, one task each.

source logs ─ sources.plan ─> Task[] ─ engine.run(work) ─> Result[] ─ journal ─> fleet.parquet, report
"""
