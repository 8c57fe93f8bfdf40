/* openpgl_common.h: what the adapters of Intel Open PGL share (C++): which device to ask for, and how large a field is.
 */
#ifndef OPENPGL_COMMON_H
#define OPENPGL_COMMON_H

#include <cstdint>
#include <cstdlib>
#include <string>
#include <vector>

#include <openpgl/cpp/OpenPGL.h>

namespace pgl = openpgl::cpp;

/* The widest vectors that both this processor and the library have. */
inline PGL_DEVICE_TYPE openpgl_device_type(size_t threads)
{
    std::vector<PGL_DEVICE_TYPE> types;
#if defined(__x86_64__) || defined(__i386__)
#ifdef OPENPGL_SUPPORT_DEVICE_TYPE_CPU_16
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512vl"))
        types.push_back(PGL_DEVICE_TYPE_CPU_16);
#endif
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
        types.push_back(PGL_DEVICE_TYPE_CPU_8);
#else
    types.push_back(PGL_DEVICE_TYPE_CPU_8);
#endif
    types.push_back(PGL_DEVICE_TYPE_CPU_4);
    for (PGL_DEVICE_TYPE type : types) /* the classes do not tell whether there is such a device: the functions do */
        if (PGLDevice device = pglNewDevice(type, threads)) {
            pglReleaseDevice(device);
            return type;
        }
    return PGL_DEVICE_TYPE_NONE;
}

/* The number in the column `name` of a table with one row, 0 where there is none. */
inline double openpgl_column(const std::string &header, const std::string &row, const std::string &name)
{
    size_t h = 0, r = 0;
    while (h < header.size() && r < row.size()) {
        size_t h_end = header.find(',', h), r_end = row.find(',', r);
        std::string title = header.substr(h, h_end - h);
        title.erase(0, title.find_first_not_of(' '));
        title.erase(title.find_last_not_of(' ') + 1); /* npos + 1 is 0 */
        if (title == name)
            return strtod(row.c_str() + r, nullptr);
        if (h_end == std::string::npos || r_end == std::string::npos)
            break;
        h = h_end + 1;
        r = r_end + 1;
    }
    return 0;
}

struct openpgl_size {
    uint64_t cells = 0, bytes = 0;
    double nodes = 0, components = 0; /* of the spatial tree; of a mixture, in the mean */
};

/* As its statistics have it, which the public headers give as a table in text only. They leave out the nodes of
   quadtrees, so that the bytes of such a field are too few. */
inline openpgl_size openpgl_measure(const pgl::Field &field)
{
    pgl::FieldStatistics s = field.GetSurfaceStatistics();
    std::string header = s.HeaderCSVString(), row = s.ToCSVString();
    openpgl_size size;
    size.cells = (uint64_t)openpgl_column(header, row, "numCacheRegions");
    size.nodes = openpgl_column(header, row, "numberOfNodes");
    size.bytes = size.cells * (uint64_t)openpgl_column(header, row, "sizePerCacheRegions(bs)") +
                 (uint64_t)openpgl_column(header, row, "sizeAllNodesUsed");
    size.components = openpgl_column(header, row, "averageNumberOfComponents");
    return size;
}

#endif
