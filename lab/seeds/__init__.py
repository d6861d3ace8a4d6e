"""Seeds of the data set: which of them succeed (`yields`), how motions differ (`motions`), and the manifest that ships."""
