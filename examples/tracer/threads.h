/* threads.h: a small pool behind one parallel_for, for the renderer and what it hands to the guiding headers. */
#ifndef TR_THREADS_H
#define TR_THREADS_H

#include "tracer.h"

typedef struct tr_pool tr_pool;

int tr_cpu_count(void);
tr_pool *tr_pool_create(int threads); /* the caller is one of them; NULL = no threads or memory to be had */
void tr_pool_destroy(tr_pool *pool);
/* A tr_parallel_fn whose user is the pool: ranges of `grain` (>= 1), handed out in order, done when it returns. */
void tr_pool_run(void *pool, uint32_t count, uint32_t grain, tr_range_fn fn, void *context);

double tr_wall_seconds(void);   /* monotonic */
double tr_cpu_seconds(void);    /* this process, all threads */
double tr_thread_seconds(void); /* CPU time of the calling thread */

#endif
