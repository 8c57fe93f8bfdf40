/* probe.c: try a library call on a file of unknown quality in a child process first.

   Assimp's importers (5.2) crash on some broken glTF files. A scene file must never take the renderer down, so a child
   imports it first; only if that ends well do we import it ourselves. It costs a second read of small files. */
#ifndef _POSIX_C_SOURCE
#define _POSIX_C_SOURCE 200809L
#endif
#include "scene_internal.h"

#include <errno.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

enum { PROBE_SECONDS = 120 };

bool tr_survives(void (*call)(void *), void *context)
{
    static const int deadly[] = {SIGSEGV, SIGBUS, SIGFPE, SIGILL, SIGABRT, SIGALRM};
    int status = 0;
    pid_t child = fork();
    if (child < 0) /* no processes left: do without */
        return true;
    if (child == 0) {
        for (size_t i = 0; i < sizeof deadly / sizeof *deadly; ++i)
            signal(deadly[i], SIG_DFL);
        alarm(PROBE_SECONDS);
        call(context);
        _exit(0);
    }
    while (waitpid(child, &status, 0) < 0)
        if (errno != EINTR)
            return true;
    return WIFEXITED(status) && WEXITSTATUS(status) == 0;
}
