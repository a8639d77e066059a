// Writes small pose graphs as slam_toolbox does, by Boost itself: its classes with their members in their order, and nothing else.
// g++ -std=c++17 -w karto_archive.cpp -lboost_serialization -o new (with -DOLD: before 2019); ./new room 6; ./new apart 6 1
#include <boost/archive/binary_oarchive.hpp>
#include <boost/archive/binary_iarchive.hpp>
#include <boost/serialization/export.hpp>
#include <boost/serialization/assume_abstract.hpp>
#include <boost/serialization/base_object.hpp>
#include <boost/serialization/vector.hpp>
#include <boost/serialization/map.hpp>
#include <boost/serialization/utility.hpp>
#include <boost/serialization/string.hpp>
#include <boost/serialization/array_wrapper.hpp>
#include <fstream>
#include <cmath>
#include <iostream>
#define S friend class boost::serialization::access; template<class A> void serialize(A&ar,const unsigned)
#define B(T) boost::serialization::base_object<T>(*this)
using std::string; using std::vector; using std::map;
typedef bool kt_bool; typedef double kt_double; typedef uint32_t kt_int32u; typedef int32_t kt_int32s; typedef uint8_t kt_int8u;
namespace karto {
struct NonCopyable { virtual ~NonCopyable(){} S {} };
struct AbstractParameter { string n,d; virtual ~AbstractParameter(){} virtual void pure()=0; S { ar&n; ar&d; } };
struct ParameterManager : NonCopyable { vector<AbstractParameter*> p; map<string,AbstractParameter*> l; S { ar&B(NonCopyable); ar&p; ar&l; } };
struct Name { string n,s; virtual ~Name(){} bool operator<(const Name&o)const{return n<o.n;} S { ar&n; ar&s; } };
struct Object : NonCopyable { Name name; ParameterManager*pm=new ParameterManager; virtual void kind()=0; S { ar&B(NonCopyable); ar&pm; ar&name; } };
struct Module : Object { virtual void reset()=0; S { ar&B(Object); } };
template<class T> struct Size2 { T w=0,h=0; S { ar&w; ar&h; } };
template<class T> struct Vector2 { T v[2]={0,0}; S { ar&v[0]; ar&v[1]; } };
template<class T> struct Rectangle2 { Vector2<T> p; Size2<T> s; S { ar&p; ar&s; } };
struct Pose2 { Vector2<double> p; double h=0; S { ar&p; ar&h; } };
struct Matrix3 { double m[3][3]={}; S { ar&m; } };
struct BoundingBox2 { Vector2<double> a,b; S { ar&a; ar&b; } };
template<class T> struct Parameter : AbstractParameter { T v; void pure() override{} S { ar&B(AbstractParameter); ar&v; } };
struct ParameterEnum : Parameter<int32_t> { map<string,int32_t> e; S { ar&B(Parameter<int32_t>); ar&e; } };
struct Sensor : Object { Parameter<Pose2>*off; virtual bool validate()=0; S { ar&B(Object); ar&off; } };
struct LaserRangeFinder : Sensor { Parameter<double>*a0,*a1,*res,*r0,*r1,*rt; ParameterEnum*type; uint32_t n=0; void kind() override{} bool validate() override{return true;}
 S { ar&B(Sensor); ar&a0; ar&a1; ar&res; ar&r0; ar&r1; ar&rt; ar&type; ar&n; } };
struct CoordinateConverter { Size2<int32_t> s; double k=20; Vector2<double> o; S { ar&s; ar&k; ar&o; } };
template<class T> struct Grid { int32_t w=0,h=0,ws=0; T*d=nullptr; CoordinateConverter*c=nullptr; virtual ~Grid(){}
 S { ar&w; ar&h; ar&ws; ar&c; if(A::is_loading::value) d=new T[ws*h]; ar&boost::serialization::make_array<T>(d,ws*h); } };
struct CustomData : Object { virtual string write()const=0; S { ar&B(Object); } };
struct SensorData : Object { int32_t state=-1,unique=-1; Name sensor; double t=0; vector<CustomData*> c; void kind() override{} 
 S { ar&state; ar&unique; ar&sensor; ar&t; ar&c; ar&B(Object); } };
struct LaserRangeScan : SensorData { double*r=nullptr; uint32_t n=0; S { ar&n; ar&B(SensorData); if(A::is_loading::value) r=new double[n]; ar&boost::serialization::make_array<double>(r,n); } };
struct LocalizedRangeScan : LaserRangeScan { Pose2 odo,cor,bar; vector<Vector2<double>> p,u; BoundingBox2 bb; bool dirty=false;
 S { ar&odo; ar&cor; ar&bar; ar&p; ar&u; ar&bb; ar&dirty; ar&B(LaserRangeScan); } };
struct DatasetInfo : Object { Parameter<string> *a=new Parameter<string>,*b=new Parameter<string>,*c=new Parameter<string>,*d=new Parameter<string>; void kind() override{} S { ar&B(Object); ar&*a; ar&*b; ar&*c; ar&*d; } };
struct Dataset { map<Name,Sensor*> look; vector<Object*> lasers; map<int32_t,Object*> data; DatasetInfo*info=nullptr; virtual ~Dataset(){}
 S { ar&look; ar&data; ar&lasers; ar&info; } };
struct LookupArray { int32_t*a=nullptr; uint32_t c=0,s=0; virtual ~LookupArray(){} S { ar&c; ar&s; if(A::is_loading::value) a=new int32_t[c]; ar&boost::serialization::make_array<int32_t>(a,c); } };
template<class T> struct GridIndexLookup { Grid<T>*g=nullptr; uint32_t c=0,s=0; LookupArray**l=nullptr; vector<double> an; virtual ~GridIndexLookup(){}
 S { ar&g; ar&c; ar&s; ar&an; if(A::is_loading::value){ l=new LookupArray*[c]; for(uint32_t i=0;i<c;i++) l[i]=new LookupArray(); } ar&boost::serialization::make_array<LookupArray*>(l,c); } };
struct MapperListener { virtual void f(){}; S {} };
struct EdgeLabel { virtual ~EdgeLabel(){} S {} };
struct LinkInfo : EdgeLabel { Pose2 a,b,d; Matrix3 c; S { ar&B(EdgeLabel); ar&a; ar&b; ar&d; ar&c; } };
template<class T> struct Edge;
template<class T> struct Vertex { T*o=nullptr; vector<Edge<T>*> e; virtual ~Vertex(){} S { ar&o; ar&e; } };
template<class T> struct Edge { Vertex<T>*a,*b; EdgeLabel*l; virtual ~Edge(){} S { ar&a; ar&b; ar&l; } };
template<class T> struct Graph {
#ifdef OLD
 map<Name,vector<Vertex<T>*>> v;
#else
 map<Name,map<int,Vertex<T>*>> v;
#endif
 vector<Edge<T>*> e; virtual ~Graph(){} S { ar&e; ar&v; } };
template<class T> struct GraphTraversal { Graph<T>*g=nullptr; virtual ~GraphTraversal(){} virtual void go()=0; S { ar&g; } };
template<class T> struct BreadthFirstTraversal : GraphTraversal<T> { void go() override{} S { ar&B(GraphTraversal<T>); } };
struct Mapper; struct ScanMatcher;
typedef LocalizedRangeScan L;
struct MapperGraph : Graph<L> { Mapper*m=nullptr; ScanMatcher*lm=nullptr; GraphTraversal<L>*t=nullptr; S { ar&B(Graph<L>); ar&m; ar&lm; ar&t; } };
struct CorrelationGrid : Grid<uint8_t> { double sm=.03; int32_t ks=0; uint8_t*k=nullptr; Rectangle2<int32_t> roi;
 S { ar&B(Grid<uint8_t>); ar&sm; ar&ks; if(A::is_loading::value) k=new uint8_t[ks*ks]; ar&boost::serialization::make_array<uint8_t>(k,ks*ks); ar&roi; } };
struct ScanMatcher { Mapper*m=nullptr; CorrelationGrid*g=nullptr; Grid<double>*pr=nullptr; GridIndexLookup<uint8_t>*lk=nullptr; std::pair<double,Pose2>*re=nullptr; vector<double> x,y; Pose2 c; double off=0,res=0; uint32_t na=0; bool pen=false; virtual ~ScanMatcher(){}
 S { ar&m; ar&g; ar&pr; ar&lk; ar&x; ar&y; ar&c; ar&res; ar&na; ar&res; ar&pen; uint32_t z=x.size()*y.size()*na; re=new std::pair<double,Pose2>[z]; ar&boost::serialization::make_array<std::pair<double,Pose2>>(re,z); } };
struct ScanManager { 
#ifdef OLD
 vector<L*> s;
#else
 map<int,L*> s;
#endif
 vector<L*> run; L*last=nullptr; uint32_t next=0,mx=70; double md=20; virtual ~ScanManager(){} S { ar&s; ar&run; ar&last; ar&mx; ar&md; ar&next; } };
struct MapperSensorManager { map<Name,ScanManager*> m; uint32_t mx=70; double md=20; int32_t next=0;
#ifdef OLD
 vector<L*> s;
#else
 map<int,L*> s;
#endif
 virtual ~MapperSensorManager(){} S { ar&m; ar&mx; ar&md; ar&next; ar&s; } };
struct Mapper : Module { bool init=true; ScanMatcher*sm=nullptr; MapperSensorManager*man=nullptr; MapperGraph*g=nullptr; vector<MapperListener*> li; Parameter<bool>*ub; Parameter<double>*mt; Parameter<uint32_t>*sb;
 void kind() override{} void reset() override{}
 S { ar&B(Module); ar&init; ar&sm; ar&g; ar&man; ar&li; ar&ub; ar&mt; ar&sb; } };
}
using namespace karto;
#define K(T) BOOST_CLASS_EXPORT(T)
K(karto::NonCopyable) K(karto::Object) K(karto::Sensor) K(karto::Name) K(karto::SensorData) K(karto::LocalizedRangeScan) K(karto::LaserRangeScan) K(karto::LaserRangeFinder) K(karto::CustomData) K(karto::Module) K(karto::Rectangle2<kt_double>) K(karto::CoordinateConverter) K(karto::Dataset) K(karto::Size2<kt_double>) K(karto::GridIndexLookup<kt_int8u>) K(karto::LookupArray) K(karto::AbstractParameter) K(karto::ParameterEnum) K(karto::ParameterManager) K(karto::Parameter<kt_double >) K(karto::Parameter<karto::Pose2>) K(karto::Parameter<kt_bool>) K(karto::Parameter<kt_int32u>) K(karto::Parameter<kt_int32s>) K(karto::Parameter<std::string>)
K(karto::MapperGraph) K(karto::Graph<karto::LocalizedRangeScan>) K(karto::EdgeLabel) K(karto::LinkInfo) K(karto::Edge<karto::LocalizedRangeScan>) K(karto::Vertex<karto::LocalizedRangeScan>) K(karto::MapperSensorManager) K(karto::Mapper)
K(karto::BreadthFirstTraversal<karto::LocalizedRangeScan>)
template<class T> Parameter<T>* par(Object&o,string n,T v){auto*p=new Parameter<T>;p->n=n;p->v=v;o.pm->p.push_back(p);o.pm->l[n]=p;return p;}
template<class G> void size(G*g,int w,int h){g->w=w;g->h=h;g->ws=(w+7)/8*8;g->d=new typename std::remove_pointer<decltype(g->d)>::type[g->ws*h]();g->c=new CoordinateConverter;g->c->s.w=w;g->c->s.h=h;}
ScanMatcher*matcher(Mapper*m){auto*s=new ScanMatcher;s->m=m;s->g=new CorrelationGrid;size<Grid<uint8_t>>(s->g,9,9);s->g->ks=3;s->g->k=new uint8_t[9]();s->pr=new Grid<double>;size(s->pr,3,3);s->lk=new GridIndexLookup<uint8_t>;s->lk->g=s->g;s->lk->c=s->lk->s=2;s->lk->an={.1,.2};s->lk->l=new LookupArray*[2];for(int i=0;i<2;i++){auto*a=s->lk->l[i]=new LookupArray;a->c=a->s=4;a->a=new int32_t[4]();}s->x={0,1};s->y={0,1};s->na=2;return s;}
int main(int argc,char**argv){ string out=argv[1];
 if(argc==2){ // reads one again, and tells the poses of its scans
  std::ifstream f(out+".posegraph"); boost::archive::binary_iarchive a(f,boost::archive::no_codecvt); Mapper m; a>>m;
  for(auto&e:m.g->e) std::cout<<e->a->o->unique<<" "<<e->b->o->unique<<" "<<e->b->o->cor.p.v[0]<<" "<<e->b->o->cor.p.v[1]<<" "<<e->b->o->cor.h<<" "<<((LinkInfo*)e->l)->b.p.v[0]<<" "<<e->b->o->p.back().v[0]<<" "<<e->b->o->bb.a.v[0]<<"\n";
  std::ifstream g(out+".data"); boost::archive::binary_iarchive b(g,boost::archive::no_codecvt); Dataset d; b>>d;
  for(auto&e:d.data){auto*l=(L*)e.second; std::cout<<e.first<<" "<<l->cor.p.v[0]<<" "<<l->cor.p.v[1]<<" "<<l->cor.h<<" "<<l->n<<"\n";} return 0; }
 int N=atoi(argv[2]); bool apart=argc>3; // without links to scan 4 and what follows

 Mapper m; m.name.n="mapper"; m.ub=par(m,"UseScanMatching",true); m.mt=par(m,"MinimumTravelDistance",.2); m.sb=par<uint32_t>(m,"ScanBufferSize",70); m.sm=matcher(&m);
 m.g=new MapperGraph; m.g->m=&m; m.g->lm=matcher(&m); auto*t=new BreadthFirstTraversal<L>; t->g=m.g; m.g->t=t;
 m.man=new MapperSensorManager; Name laser; laser.n="laser"; laser.s="robot"; auto*sc=new ScanManager; m.man->m[laser]=sc;
 Dataset d; auto*lf=new LaserRangeFinder; lf->name=laser; lf->off=par(*lf,"OffsetPose",Pose2()); lf->off->v.p.v[0]=.1; lf->a0=par(*lf,"MinimumAngle",-M_PI); lf->a1=par(*lf,"MaximumAngle",M_PI-M_PI/18); lf->res=par(*lf,"AngularResolution",M_PI/18); lf->r0=par(*lf,"MinimumRange",.1); lf->r1=par(*lf,"MaximumRange",30.); lf->rt=par(*lf,"RangeThreshold",12.); lf->type=new ParameterEnum; lf->type->n="Type"; lf->type->v=0; lf->type->e["Custom"]=0; lf->pm->p.push_back(lf->type); lf->pm->l["Type"]=lf->type; lf->n=36;
 d.look[laser]=lf; d.lasers.push_back(lf);
 vector<Vertex<L>*> vs;
 for(int i=0;i<N;i++){ auto*s=new L; s->state=s->unique=i; s->sensor=laser; s->t=100+i; s->n=36; s->r=new double[36];
  double px=.5*i,py=.1*i,ph=.05*i; s->odo.p.v[0]=px+.01*i; s->cor.p.v[0]=px; s->cor.p.v[1]=py; s->cor.h=ph;
  double sx=px+.1*cos(ph),sy=py+.1*sin(ph);
  for(int k=0;k<36;k++){ double a=-M_PI+k*M_PI/18+ph,cx=cos(a),cy=sin(a); double rx=cx>0?(6-sx)/cx:(-2-sx)/cx, ry=cy>0?(3-sy)/cy:(-2-sy)/cy; double r=std::min(fabs(cx)<1e-9?1e9:rx,fabs(cy)<1e-9?1e9:ry); s->r[k]=k==7?INFINITY:r; Vector2<double> p; p.v[0]=sx+r*cx; p.v[1]=sy+r*cy; if(k!=7) s->p.push_back(p); s->u.push_back(p);} 
  s->bb.a.v[0]=-2; s->bb.a.v[1]=-2; s->bb.b.v[0]=6; s->bb.b.v[1]=3; s->bar.p.v[0]=1;
  auto*v=new Vertex<L>; v->o=s; vs.push_back(v);
#ifdef OLD
  m.g->v[laser].push_back(v); sc->s.push_back(s); m.man->s.push_back(s);
#else
  m.g->v[laser][i]=v; sc->s[i]=s; m.man->s[i]=s;
#endif
  sc->run.push_back(s); sc->last=s; d.data[i]=s; }
 sc->next=m.man->next=N;
 auto link=[&](int a,int b){auto*e=new Edge<L>; e->a=vs[a]; e->b=vs[b]; auto*l=new LinkInfo; l->a=vs[a]->o->cor; l->b=vs[b]->o->cor; l->d.p.v[0]=.5; for(int i=0;i<3;i++) l->c.m[i][i]=.01*(i+1); e->l=l; vs[a]->e.push_back(e); vs[b]->e.push_back(e); m.g->e.push_back(e);};
 for(int i=1;i<N;i++) if(!apart||i!=4) link(i-1,i); if(N>4&&!apart) link(0,4);
#ifdef OLD
 m.g->v[laser].push_back(nullptr); // as a removed scan leaves it
#endif
 { std::ofstream o(out+".posegraph"); boost::archive::binary_oarchive a(o,boost::archive::no_codecvt); const Mapper&c=m; a<<c; }
 { std::ofstream o(out+".data"); boost::archive::binary_oarchive a(o,boost::archive::no_codecvt); const Dataset&c=d; a<<c; }
 return 0; }
