def write_report(results, names): pass
