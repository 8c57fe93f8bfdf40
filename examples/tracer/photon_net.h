/* photon_net.h: the network of guide_nn.h between the maps of guide_photon.h: what it is fed, what becomes of its
   answer, and when it runs. The renderer and the training share it. */
#ifndef TR_PHOTON_NET_H
#define TR_PHOTON_NET_H

#include "guide_nn.h"
#include "guide_photon.h"
#include "tracer.h"

/* ---- one map */

enum {
    PN_ROWS = 32,
    PN_COLUMNS = 64,
    PN_AREA = PN_ROWS * PN_COLUMNS,
    PN_INPUTS = 7 /* the repaired map, the five of gph_export_maps, the logarithm of the number of photons */
};

/* The architecture that the weights are for. */
gnn_unet_desc pn_desc(void);
/* One voxel's inputs[PN_INPUTS][PN_AREA] from its repaired map (mean 1), its features[GPH_FEATURES][PN_AREA] and the
   number of its photons. */
void pn_inputs(const float *repaired, const float *features, float photons, float *inputs);
/* The truth, any scale, as the network is to answer it. */
void pn_truth(const float *truth, float *target);
/* What it answered as a map to sample, with mean 1; repaired as in pn_inputs. */
void pn_map(const float *repaired, const float *output, float *map);
/* The map that a handle samples, as floats with mean 1. */
void pn_repaired(const gph_handle *handle, float *map);

/* ---- in the renderer */

typedef struct photon_net photon_net;

/* Read the weights; path NULL = those that come with the renderer: examples/weights/histogram.safetensors beside the
   folder of the running program, where the system tells it, else in the working directory. share: of the CPU time spent
   so far that the network may take, counted in work, not measured. tiles: that photon_net_see is told. NULL with a
   reason in err. */
photon_net *photon_net_create(const char *path, double share, int tiles, char *err, size_t err_size);
void photon_net_destroy(photon_net *net);
/* Vertices of camera paths, to know which voxels they need most. One thread per tile at a time. */
void photon_net_see(photon_net *net, int tile, const tr_vertex *vertices, int n);
/* After gph_refine: reconstruct the maps that it made anew and camera paths read, those that they met most often first,
   as far as the share goes. False = out of memory; the field is as gph_refine left it then. The result does not depend
   on threads. It does on the level of SIMD, which rounds guide_nn.h's sums otherwise: so may pictures. */
bool photon_net_refine(photon_net *net, gph_field *field, tr_parallel_fn parallel, void *parallel_user);
/* More JSON members, each after a comma. */
void photon_net_stats(const photon_net *net, char *text, size_t size);

#endif
