"""From folders of videos to score tables: jobs, worker threads, tables on disk, summaries, bundles."""

__all__ = ["bundle", "jobs", "scores", "summary", "workers"]
