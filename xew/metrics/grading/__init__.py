"""From folders of videos to score tables: jobs, baselines, worker threads, tables on disk, summaries, bundles."""

__all__ = ["baselines", "bundle", "jobs", "scores", "summary", "workers"]
