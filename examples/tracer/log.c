/* log.c: messages about a scene, with file and line; the files that it is made of. */
#include "tracer.h"

static const char *const level_names[3] = {"note", "warning", "error"};

#if defined(__GNUC__)
__attribute__((format(printf, 5, 6)))
#endif
void tr_message(tr_log *log, tr_level level, const char *file, int line, const char *format, ...)
{
    char text[400], where[200] = "";
    va_list args;
    if (!log)
        return;
    va_start(args, format);
    vsnprintf(text, sizeof text, format, args);
    va_end(args);
    if (file && line > 0)
        snprintf(where, sizeof where, "%s:%d: ", file, line);
    else if (file)
        snprintf(where, sizeof where, "%s: ", file);
    int *count = level == TR_NOTE ? &log->notes : level == TR_WARNING ? &log->warnings : &log->errors;
    snprintf(log->last, sizeof log->last, "%.180s%s: %.300s", where, level_names[level], text);
    ++*count;
    if (!log->out)
        return;
    if (*count <= TR_LOG_SHOWN)
        fprintf(log->out, "%s%s: %s\n", where, level_names[level], text);
    else if (*count == TR_LOG_SHOWN + 1)
        fprintf(log->out, "%s: more of these are not shown\n", level_names[level]);
}

void tr_file_used(tr_log *log, const char *path)
{
    if (log && log->on_file)
        log->on_file(log->user, path);
}
