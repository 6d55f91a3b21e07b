/* How well poses explain remembered scans: `Memory.explain` of memory.py, pose by pose, without the
   arrays that numpy makes on the way. Any change here is a change there; tests hold both equal.
   Built with -ffast-math: nothing in here is infinite or not a number. Loops over the taxels near a
   press run over whole vectors, the last one filled up with taxels that tell nothing. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>

/* SHA-256 of this file, as it was built */
const char taxeld_source[] = SOURCE;

#if defined(__x86_64__) && defined(__GLIBC__) && !defined(__clang__)
#define FASTEST __attribute__((target_clones("avx2", "default")))  /* by the processor */
#else
#define FASTEST
#endif
#define INLINE static inline __attribute__((always_inline))  /* into each of the clones */

enum { Z, LEVEL, RESIDUE, LOW, HIGH, ROOT, SILENT, LIVE };  /* of what is kept */
enum { LANES = 8 };  /* of a vector, at most */

typedef struct {
    const float *distance;  /* (ny, nx, heights) signed distances [m] */
    const uint8_t *pressed, *about, *reach;  /* (ny, nx) cells that count, of a taxel or an axis */
    const float *place;  /* (3, places) x, y [m], 1: taxels stand in columns */
    const int64_t *taxel, *height;  /* (places, most) which they are, or -1; which slice is theirs */
    int64_t nx, ny, heights, places, most, taxels;
    double x, y, cell, depth_max;  /* of the grid's origin, of its cells, of full scale [m] */
    double band, hidden, robust;  /* BAND_M, HIDDEN and ROBUST */
    double least_variance, iterations;
    double sigma, gain_cv, outliers, least, farthest, bowling1, bowling3;  /* of `Noise` */
} Model;

typedef struct {
    const float *kept;  /* (8, all, taxels), of which `scans` are asked for */
    const double *sensor;  /* (scans, 3) */
    const double *variance;  /* (scans,) of each one's offset [m^2] */
    const uint8_t *silent;  /* (scans,) */
    int64_t scans, all, about;  /* about: whether contacts have an offset */
} Scans;

typedef struct {
    const int64_t *order;  /* (scans,) in which they are looked at */
    const double *share;  /* (scans,) of each in what is needed */
    const double *left;  /* (scans,) that they may add at most, from each of the order on */
    const double *least;  /* (n,) that must be added for a pose to be of any use */
} Bounds;

typedef struct {  /* room for one pose and scan */
    float *u, *v;  /* (places,) where columns are in their cells */
    uint32_t *cell;  /* (places,) */
    float *depth, *gx, *gy, *away, *ax, *ay;  /* of taxels near a press, one after the other, */
    float *z, *level, *residue, *root, *silent;  /* and what is kept of them */
    int64_t n;
} Near;

INLINE float within(float value, float low, float high)
{
    value = value > low ? value : low;
    return value < high ? value : high;
}

/* The taxels that a pose presses, or nearly, the sensor at (x, y) in cells and turned. */
INLINE void look_up(
    const Model *m, Near *near, const float *kept, int64_t field, float x, float y, float cosine,
    float sine, int about)
{
    const float *px = m->place, *py = px + m->places;
    float *restrict us = near->u, *restrict vs = near->v;
    uint32_t *restrict cells = near->cell, nx = m->nx, last = (m->ny - 1) * m->nx - 2;
    float right = m->nx - 1.001, top = m->ny - 1.001, band = about ? m->band : 0.0;
    float by_depth = -1.0 / m->depth_max, by_cell = by_depth / m->cell;
    float *restrict depth = near->depth, *restrict gx = near->gx, *restrict gy = near->gy;
    float *restrict z = near->z, *restrict level = near->level, *restrict residue = near->residue;
    float *restrict root = near->root, *restrict silent = near->silent;
    const uint8_t *mask = about ? m->about : m->pressed;
    int64_t n = 0, up = m->nx * m->heights, across = m->heights;
    for (int64_t i = 0; i < m->places; i++) {
        float u = within(cosine * px[i] - sine * py[i] + x, 0.0f, right);
        float v = within(sine * px[i] + cosine * py[i] + y, 0.0f, top);
        int32_t column = (int32_t)u, row = (int32_t)v;
        us[i] = u - column;
        vs[i] = v - row;
        cells[i] = (uint32_t)row * nx + (uint32_t)column;
    }
    for (int64_t i = 0; i < m->places; i++) {
        if (cells[i] > last || !mask[cells[i]])  /* beyond: of a pose that is not a number */
            continue;
        const float *corner = m->distance + cells[i] * m->heights;
        float u = us[i], v = vs[i];
        for (int64_t j = i * m->most; j < (i + 1) * m->most && m->taxel[j] >= 0; j++) {
            const float *at = corner + m->height[j];
            float below = at[across] - at[0], above = at[up + across] - at[up];
            float low = at[0] + below * u, high = at[up] + above * u;
            float distance = low + (high - low) * v;
            if (!(distance < band))
                continue;
            const float *read = kept + m->taxel[j];
            depth[n] = distance * by_depth;
            gx[n] = (below + (above - below) * v) * by_cell;
            gy[n] = (high - low) * by_cell;
            z[n] = read[Z * field];
            level[n] = read[LEVEL * field];
            residue[n] = read[RESIDUE * field];
            root[n] = read[ROOT * field];
            silent[n++] = read[SILENT * field];
        }
    }
    for (; n % LANES; n++)  /* not believed */
        depth[n] = gx[n] = gy[n] = z[n] = level[n] = residue[n] = root[n] = silent[n] = 0.0f;
    near->n = n;
}

/* `Readings.offset` of offsets.py: moves the depths to where the offset explains the readings best;
   what the integral over it adds. */
INLINE double offset(const Model *m, Near *near, double variance)
{
    double precision = 1.0 / (variance > m->least_variance ? variance : m->least_variance);
    double x = 0.0, y = 0.0, det = precision * precision;
    float robust = m->robust;
    float *restrict away = near->away, *restrict ax = near->ax, *restrict ay = near->ay;
    float *restrict depth = near->depth;
    const float *restrict gx = near->gx, *restrict gy = near->gy;
    const float *restrict level = near->level, *restrict root = near->root, *restrict z = near->z;
    int64_t n = near->n;
    for (int64_t i = 0; i < n; i++) {
        away[i] = (level[i] - depth[i]) * root[i];
        ax[i] = gx[i] * root[i];
        ay[i] = gy[i] * root[i];
    }
    for (int iteration = 0; iteration < (int)m->iterations; iteration++) {
        float xx = 0, xy = 0, yy = 0, bx = 0, by = 0, ex = x, ey = y;
        for (int64_t i = 0; i < n; i++) {
            float off = away[i] - ax[i] * ex - ay[i] * ey;
            off = z[i] < 1.0f || off > 0.0f ? off : 0.0f;  /* LOW and HIGH */
            off = z[i] > 0.0f || off < 0.0f ? off : 0.0f;
            float size = fabsf(off);
            float weight = off == 0.0f ? 0.0f : robust / (size > robust ? size : robust);
            xx += weight * ax[i] * ax[i];
            xy += weight * ax[i] * ay[i];
            yy += weight * ay[i] * ay[i];
            bx += weight * ax[i] * off;
            by += weight * ay[i] * off;
        }
        double hxx = xx + precision, hyy = yy + precision, hxy = xy;
        double rx = bx - precision * x, ry = by - precision * y;
        det = hxx * hyy - hxy * hxy;
        x += (hyy * rx - hxy * ry) / det;
        y += (hxx * ry - hxy * rx) / det;
    }
    float ex = x, ey = y;
    for (int64_t i = 0; i < n; i++)
        depth[i] += gx[i] * ex + gy[i] * ey;
    return -0.5 * ((x * x + y * y) * precision + log(det / (precision * precision)));
}

/* By how much readings are likelier at these depths, less `hidden`, than of taxels that are not
   pressed: `Noise.log_density`. */
INLINE double gain(const Model *m, const Near *near, float hidden)
{
    float sigma2 = m->sigma * m->sigma, cv2 = m->gain_cv * m->gain_cv, farthest = m->farthest;
    float b1 = m->bowling1, b3 = m->bowling3, keep = 1.0 - m->outliers, least = m->least;
    float sum = 0.0f;
    const float *restrict depth = near->depth, *restrict residue = near->residue;
    const float *restrict z = near->z, *restrict level = near->level;
    const float *restrict silent = near->silent, *restrict root = near->root;
    for (int64_t i = 0; i < near->n; i++) {
        float h = within(depth[i] - hidden, 0.0f, 1.0f);
        float variance = sigma2 + cv2 * h * h + residue[i] * residue[i];
        float off = within((level[i] - h) / sqrtf(variance), -farthest, farthest);
        float square = off * off, beyond = (z[i] > 0.0f ? off : -off) * (b1 + b3 * square);
        int is_told = (z[i] > 0.0f) & (z[i] < 1.0f);
        float power = expf(is_told ? -0.5f * square : beyond);
        float likely = is_told ? power / sqrtf(6.2831853f * variance) : 1.0f / (1.0f + power);
        float gained = logf(keep * likely + least) - silent[i];
        sum += root[i] > 0.0f ? gained : 0.0f;
    }
    return sum;
}

/* Room for `near`; NULL where there is no memory left. */
static void *room_for(const Model *m, Near *near)
{
    float **each[] = {&near->depth, &near->gx, &near->gy, &near->away, &near->ax, &near->ay,
                      &near->z, &near->level, &near->residue, &near->root, &near->silent};
    int64_t fields = sizeof(each) / sizeof(*each), columns = m->places, taxels = m->taxels + LANES;
    float *at = malloc((3 * columns + fields * taxels) * sizeof(float));
    void *room = at;
    if (!room)
        return NULL;
    near->u = at;
    near->v = at + columns;
    near->cell = (uint32_t *)(at + 2 * columns);
    for (int k = 0; k < fields; k++)
        *each[k] = at + 3 * columns + k * taxels;
    return room;
}

/* By how much a scan is likelier than of a skin which is not pressed, of a pose (3,) whose turn has
   this cosine and sine. */
INLINE double explained(
    const Model *m, const Scans *s, Near *near, int64_t k, const double *pose, double c, double sn)
{
    const double *sensor = s->sensor + 3 * k;
    double dx = sensor[0] - pose[0], dy = sensor[1] - pose[1], turn = sensor[2] - pose[2];
    double x = (c * dx + sn * dy - m->x) / m->cell, y = (c * dy - sn * dx - m->y) / m->cell;
    uint32_t column = (int32_t)within(x, 0.0f, m->nx - 1.001);
    uint32_t row = (int32_t)within(y, 0.0f, m->ny - 1.001);
    if (column >= m->nx - 1 || row >= m->ny - 1 || !m->reach[row * m->nx + column])
        return 0.0;
    int about = s->about && !s->silent[k];
    double variance = s->variance[k];
    look_up(m, near, s->kept + k * m->taxels, s->all * m->taxels, x, y, cos(turn) / m->cell,
            sin(turn) / m->cell, about);
    if (!near->n)
        return 0.0;
    if (!about)
        return gain(m, near, m->hidden / m->depth_max * sqrt(variance));
    double added = offset(m, near, variance);
    return added + gain(m, near, 0.0f);
}

/* log p(scan | pose) beyond that of a skin which is not pressed, of poses (n, 3): out (n, scans).
   With bounds, a pose that cannot come up to them is given up before all scans were looked at.
   0, or -1 where there is no memory left. */
FASTEST int taxeld_explain(
    const Model *m, const Scans *s, const Bounds *bounds, const double *poses, int64_t n,
    double given_up, double *out)
{
    Near near;
    void *room = room_for(m, &near);
    if (!room)
        return -1;
    for (int64_t i = 0; i < n; i++) {
        const double *pose = poses + 3 * i;
        double c = cos(pose[2]), sn = sin(pose[2]), sum = 0.0, *met = out + i * s->scans;
        int64_t j = 0;
        for (; j < s->scans; j++) {
            int64_t k = bounds ? bounds->order[j] : j;
            if (bounds && sum + bounds->left[j] < bounds->least[i])
                break;
            met[k] = explained(m, s, &near, k, pose, c, sn);
            sum += bounds ? bounds->share[k] * met[k] : 0.0;
        }
        for (int64_t k = 0; j < s->scans && k < s->scans; k++)
            met[k] = given_up;
    }
    free(room);
    return 0;
}
