/* building.h: room for building trees that no samples made, for the tests. After guide_sdtree.h. */
#ifndef TEST_BUILDING_H
#define TEST_BUILDING_H

#include <string.h>

/* Add `more` nodes, all zero, to a field's building part. Returns the first of them; gsdi_field_changed is to follow.
 */
static inline uint32_t more_building_nodes(gsd_field *f, uint32_t more)
{
    uint32_t first = f->building_nodes, all = first + more;
    uint32_t *child = f->desc.allocate(f->desc.user, all * sizeof *child);
    gsdi_sum *sum = f->desc.allocate(f->desc.user, all * sizeof *sum);
    memcpy(child, f->child, first * sizeof *child);
    memcpy(sum, f->sum, first * sizeof *sum);
    memset(child + first, 0, more * sizeof *child);
    memset(sum + first, 0, more * sizeof *sum);
    f->desc.release(f->desc.user, f->child);
    f->desc.release(f->desc.user, f->sum);
    f->child = child;
    f->sum = sum;
    f->building_nodes = f->node_capacity = all;
    return first;
}

#endif
