"""Many logs, one task each: what to do (`task`, `work`), where (`sources`), on whom (`engine`), what is done (`journal`).

source logs ─ sources.plan ─> Task[] ─ engine.run(work) ─> Result[] ─ journal ─> fleet.parquet, report
"""
